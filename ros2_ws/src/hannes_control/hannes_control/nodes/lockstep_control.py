"""The motor driven in lock-step: one answer to each tick, once all of it is here (see hannes_ros.lockstep)."""

from __future__ import annotations

from time import monotonic

from hannes_ros import topics
from hannes_ros.diagnostics import OK, WARN, Arrivals, silence
from hannes_ros.lockstep import SETTLE_S, Peers, Probe, TickJoin
from hannes_ros.node import Host
from hannes_ros.sources import Sources

from .motor_drive import MotorDrive
from .motor_inputs import INPUTS

_TOPICS = tuple(topics.signal(name).topic for name in INPUTS)


class LockstepControl:
    """Drives the motor while it is on; what must not happen in lock-step ends the node.

    node     its log and its end
    sources  publishers of the inputs
    peers    who must hear the answers
    period   s
    """

    missed = 0
    """Periods that were missed: none, time waits."""
    tripped = False
    """Nothing switches the motor off."""

    def __init__(
        self,
        node: Host,
        drive: MotorDrive,
        sources: Sources,
        peers: Peers,
        *,
        period: float,
    ) -> None:
        self._node, self._drive, self._sources, self._peers = node, drive, sources, peers
        self._period_ns = round(period * 1e9)
        self.active = False
        self._arrivals = Arrivals()
        self._join = TickJoin(3 if drive.follows_topic else 2)
        self._probe = Probe(sources.mixed)
        self.heard = self._probe.on_match
        self._answered = self._came = -1
        self._began: int | None = None
        self._reported = 0
        self.last_input = 0.0

    def on(self) -> None:
        """Motor on; a profile of its own begins with the tick that is answered first."""
        self.active, self._began = True, None
        if self._join.synchronised:
            self._answer()

    def off(self) -> None:
        """Motor off: no tick is answered."""
        self.active = False

    # -- inputs ------------------------------------------------------------------------------------------------------
    def on_state(self, data: bytes) -> None:
        """A motor/state came: a tick, or a tick again."""
        sample = self._drive.inputs.state(data)
        if sample is None:
            return
        self._drive.health.faults.good("motor/state")
        jumps = 0 <= self._came < sample.stamp_ns - self._period_ns
        if (jumps or (self._probe.held and sample.stamp_ns != self._came)) and self._sources.mixed():
            # No simulator leaves out ticks, or begins again while its tick is held.
            self._node.fail(self._sources.surplus(INPUTS[0]))
            return
        if sample.stamp_ns < self._answered:  # the simulator began again
            self._join.reset()
            self._answered = self._came = -1
            self._began = None
            self._drive.inputs.reference = None
            self._drive.clear()
        elif sample.stamp_ns == self._came:  # repeated to a newcomer
            self._join.rejoin()
        self._came = sample.stamp_ns
        self._put(0, sample)
        self._arrivals.came(self.last_input)

    def on_current(self, data: bytes) -> None:
        """A motor/current came."""
        self._put(1, self._drive.inputs.current(data))

    def on_reference(self, data: bytes) -> None:
        """A reference came."""
        self._put(2, self._drive.inputs.take_reference(data))

    def _put(self, slot: int, item: object) -> None:
        self.last_input = monotonic()
        self._join.put(slot, item)
        if self._join.synchronised:
            self._answer()
        if self._join.surplus is not None:
            self._on_surplus(self._join.surplus)

    def _on_surplus(self, slot: int) -> None:
        """Messages of another source end the node; what one source repeated too late for `rejoin` is joined anew."""
        name = INPUTS[slot]
        if slot == 0 and self._join.synchronised:
            name = "motor_voltage"  # somebody else has answered, or the next motor/state would not be there
        if not self._join.synchronised or self._sources.count(name) > 1:
            self._node.fail(self._sources.surplus(name))
            return
        self._drive.health.count("rejoins")
        self._node.get_logger().warning(f"{topics.signal(name).topic} is ahead of the ticks: joined anew")
        self._join.rejoin()

    # -- answers -----------------------------------------------------------------------------------------------------
    def _answer(self) -> None:
        """Answer the tick if all of it is here, the motor is on and the answer will be heard."""
        while self.active and self._peers.complete and self._join.complete:
            if self._join.synchronised and self._probe.holds():
                return
            tick = self._join.take()
            assert tick is not None
            sample, current = tick[0], tick[1]
            if sample.stamp_ns == self._answered:
                continue
            step_ns = sample.stamp_ns - self._answered
            if self._answered >= 0 and step_ns != self._period_ns:
                several = self._sources.several()
                self._node.fail(
                    f"motor/state comes every {step_ns * 1e-9:g} s, but the control period is "
                    f"{self._period_ns * 1e-9:g} s; give hand_sim and motor_controller the same period"
                    + (f" ({several})." if several else ".")
                )
                return
            drive = self._drive
            if self._began is None:
                self._began = sample.stamp_ns
            since = (sample.stamp_ns - self._began) // self._period_ns
            own = None if drive.follows_topic else drive.profile_at(since)
            self._answered = sample.stamp_ns
            if not self._join.synchronised:
                self._join.synchronise()
                self._probe.due = True
            drive.drive(tick[2] if own is None else own, sample.position[0], current)

    def check(self) -> str | None:
        """Called often: looks at a tick that was held, and answers the first one."""
        if self._probe.over() and self._join.synchronised:
            if (left_over := self._join.left_over) is not None:
                self._on_surplus(left_over)
            else:
                self._answer()
        settled = monotonic() - self.last_input >= SETTLE_S
        if not self._peers.missing() and not self._join.synchronised and settled:
            self._answer()
        return None

    # -- health ------------------------------------------------------------------------------------------------------
    def state_rate(self) -> float | None:
        """Rate of motor/state, 1/s of wall time."""
        return self._arrivals.rate()

    def status(self) -> tuple[bytes, str]:
        """How the answers of a motor that is on do."""
        if absent := self._peers.missing():
            return WARN, f"waiting for {', '.join(absent)}"
        # Within a tick something is missing always: what counts is whether none was answered since the last report.
        cycles = self._drive.health.cycles
        answered, self._reported = cycles > self._reported, cycles
        missing = [] if answered else [_TOPICS[slot] for slot in self._join.missing()]
        if not missing:
            return OK, "running"
        silent = self.last_input and silence({"any message": self.last_input})
        return WARN if silent else OK, f"waiting for {', '.join(missing)}"
