"""The motor driven in real time: the newest state, current and reference at each period of a thread of its own."""

from __future__ import annotations

from time import monotonic

from hannes_ros import convert, topics
from hannes_ros.diagnostics import ERROR, OK, SAY_AGAIN_S, WARN, Arrivals, silence
from hannes_ros.lockstep import Peers
from hannes_ros.loop import RealtimeLoop
from hannes_ros.node import Host
from hannes_ros.reach import not_beyond

from .motor_drive import MotorDrive
from .motor_inputs import INPUTS

SLOWEST_STATE_HZ = 80.0
_PATIENCE_S = 2.0
"""s for which an input may be waited for without a word in the log."""
_ANOTHER_CLOCK_S = 0.5
"""Stamps that are so far off, or for so long without a good one between, are of another clock; others are late."""
_MOST_IMPOSSIBLE = 10
"""Readings since the activation that no hand gives, from which on the motor is off: at 0 V a hand that tells mA
soon draws little enough to be believed again."""
TOO_OLD = "motor/state or motor/current is too old: 0 V"
_STATE, _CURRENT, _REFERENCE = (topics.signal(name).topic for name in INPUTS)


class RealtimeControl:
    """Drives the motor while it is on.

    node      its clock, its log and its end
    peers     who must be there before a profile of one's own begins
    period    s
    timeout   s from which on a state or a current is too old
    pause     s; a pause of the loop that is longer switches the motor off
    tripped   the motor must be switched off, or was for that reason
    """

    heard = None
    """What to call when a publisher of an input comes or goes."""

    def __init__(
        self,
        node: Host,
        drive: MotorDrive,
        peers: Peers,
        *,
        period: float,
        timeout: float,
        pause: float,
    ) -> None:
        self._node, self._drive, self._peers = node, drive, peers
        self._period, self._timeout, self._pause = period, timeout, pause
        self.active = self.tripped = False
        self._loop: RealtimeLoop | None = None
        self._missed = 0
        self._arrivals = Arrivals()
        self._state: convert.JointSample | None = None
        self._current: float | None = None
        self._state_at = self._current_at = 0.0
        self._stale = self._said_stale = False
        self._late_since: float | None = None
        self._waits_since: float | None = None
        self._played = -1

    @property
    def last_input(self) -> float:
        """Time of the latest motor/state that was used, s (monotonic); 0 if there was none."""
        return self._state_at

    def on(self) -> None:
        """Motor on."""
        self.active, self.tripped, self._drive.inputs.impossible = True, False, 0
        self._played = -1
        self._loop = RealtimeLoop(self._period, self._step)
        self._loop.start()

    def off(self) -> None:
        """Motor off."""
        was_active, self.active = self.active, False
        if self._loop is not None:
            self._loop.stop()
            self._missed += self._loop.missed
            self._loop = None
        if was_active:
            self._drive.end()

    # -- inputs ------------------------------------------------------------------------------------------------------
    def on_state(self, data: bytes) -> None:
        """A motor/state came."""
        inputs = self._drive.inputs
        sample = inputs.state(data)
        if sample is None:
            return
        age = (self._node.get_clock().now().nanoseconds - sample.stamp_ns) * 1e-9
        if abs(age) > self._timeout:
            now = monotonic()
            self._late_since = now if self._late_since is None else self._late_since
            if abs(age) > _ANOTHER_CLOCK_S or now - self._late_since > _ANOTHER_CLOCK_S:
                inputs.reject_state(ERROR, self._wrong_stamp(sample.stamp_ns, age))
            else:  # a busy machine
                self._drive.health.count("rejected_states")
            return
        self._late_since = None
        if self._state is not None and sample.stamp_ns <= self._state.stamp_ns and not self._stale:
            inputs.reject_state(WARN, "its stamp is not later than the one before")
            return
        self._drive.health.faults.good("motor/state")
        self._state, self._state_at = sample, monotonic()
        self._arrivals.came(self._state_at)

    def _wrong_stamp(self, stamp_ns: int, age: float) -> str:
        """What is wrong with a stamp that is `age` s old, or ahead where that is negative."""
        if self._node.get_clock().ros_time_is_active:
            clock = "/clock (use_sim_time)"
        else:
            clock = "the clock of this machine (for a played bag set use_sim_time)"
        if not stamp_ns:
            return (
                f"its header has no stamp; set it by {clock}. A hand_sim in lock-step counts from 0: give the "
                "controller clock:=lockstep too"
            )
        side = "before" if age > 0.0 else "after"
        return f"it is stamped {abs(age):.3g} s {side} {clock}; {self._timeout:g} s are allowed"

    def on_current(self, data: bytes) -> None:
        """A motor/current came."""
        self._current, self._current_at = self._drive.inputs.current(data), monotonic()

    def on_reference(self, data: bytes) -> None:
        """A reference came."""
        self._drive.inputs.take_reference(data)

    # -- the loop ----------------------------------------------------------------------------------------------------
    def _step(self, now: float, elapsed: int) -> None:
        """One period of the real-time thread."""
        if not self.active or self.tripped:
            return
        if elapsed * self._period > self._pause:
            self.tripped = True
            return
        drive = self._drive
        if self._state is None or self._current is None or self._peers.missing():
            self._missed -= elapsed - 1  # nothing was to be done in them
            return
        if now - min(self._state_at, self._current_at) > self._timeout:
            if not self._stale:
                self._stale = True
                drive.health.count("state_timeouts")
                drive.clear()
            drive.coast()
            return
        self._stale = False
        # a profile begins with the first period that has live sensors, and stands while they are stale
        self._played += elapsed if self._played >= 0 else 1
        reference = drive.inputs.reference if drive.follows_topic else drive.profile_at(self._played)
        drive.drive(reference, self._state.position[0], self._current)

    def check(self) -> str | None:
        """Called often: why the motor must be switched off, if it must."""
        stale = self.active and self._stale
        if stale and not self._said_stale:
            self._node.get_logger().error(TOO_OLD, throttle_duration_sec=SAY_AGAIN_S)
        self._said_stale = stale
        if self._loop is not None and self._loop.error is not None:
            self._node.fail(f"The control loop stopped: {self._loop.error!r}")
        if not self.active:
            return None
        impossible = self._drive.inputs.impossible
        if impossible >= _MOST_IMPOSSIBLE:
            self.tripped = True
            return f"{impossible} readings that no hand gives: motor off; mend what the board sends"
        if self.tripped:
            return f"the control loop paused for more than {self._pause * 1e3:g} ms: motor off"
        return None

    # -- health ------------------------------------------------------------------------------------------------------
    @property
    def missed(self) -> int:
        """Periods that were missed since the node started."""
        return self._missed + (self._loop.missed if self._loop else 0)

    def state_rate(self) -> float | None:
        """Rate of motor/state, 1/s; too low a one is a fault."""
        rate, faults = self._arrivals.rate(), self._drive.health.faults
        if rate is None or rate >= SLOWEST_STATE_HZ:
            faults.good("rate")
        else:
            said = (
                f"motor/state comes at {rate:.0f} Hz: the loop needs 100 Hz, or it oscillates; best is 1 kHz"
            )
            faults.bad("rate", WARN, said)
        return rate

    def status(self) -> tuple[bytes, str]:
        """How the loop of a motor that is on does."""
        if self._stale:
            return ERROR, TOO_OLD
        inputs, faults = self._drive.inputs, self._drive.health.faults
        heard: dict[str, object] = {_STATE: self._state, _CURRENT: self._current}
        if self._drive.follows_topic:
            heard[_REFERENCE] = inputs.reference
        absent = [topic for topic, value in heard.items() if value is None and topic not in faults]
        absent += self._peers.missing()
        if absent:
            waiting, now = f"waiting for {', '.join(absent)}", monotonic()
            self._waits_since = self._waits_since or now
            if now - self._waits_since > _PATIENCE_S:
                self._node.get_logger().warning(waiting + not_beyond(), throttle_duration_sec=30.0)
            return WARN, waiting
        self._waits_since = None
        if self._drive.follows_topic and (silent := silence({_REFERENCE: inputs.reference_at})):
            return WARN, f"{silent}: the last one is held"
        return OK, "running"
