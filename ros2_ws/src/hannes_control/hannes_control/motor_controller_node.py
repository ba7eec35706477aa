"""motor_controller: the double PID as a lifecycle node; state, current and reference in, motor/voltage out."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from time import monotonic

import hannes_ros.early  # noqa: F401  (signals are safe from here on)
from hannes_description.errors import HannesError
from hannes_description.joints import RAD_PER_COUNT
from hannes_description.model import Model
from hannes_ros import convert, topics
from hannes_ros.diagnostics import ERROR, OK, SAY_AGAIN_S, WARN, Arrivals, Diagnostics, Health, silence
from hannes_ros.lockstep import SETTLE_S, Peers, Probe, TickJoin
from hannes_ros.loop import RealtimeLoop
from hannes_ros.node import CLOCK_HELP, CLOCKS, DEFAULT_NAMESPACE, HannesNode
from hannes_ros.node_parameters import declare, parameter
from hannes_ros.reach import not_beyond
from hannes_ros.run import run_node
from hannes_ros.sources import Sources
from hannes_ros.telling import LOOP, loop_of, tell
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

from .double_pid import DoublePID
from .reference import FULL_CLOSURE, PROFILES, Profile, check_travel, make_profile, travel_of

_CHECK_S = 0.02
_SLOWEST_STATE_HZ = 80.0
_PATIENCE_S = 2.0
"""s for which an input may be waited for without a word in the log."""
_ANOTHER_CLOCK_S = 0.5
"""Stamps that are so far off, or for so long without a good one between, are of another clock; others are late."""
_MOST_IMPOSSIBLE = 10
"""Readings since the activation that no hand gives, from which on the motor is off: at 0 V a hand that tells mA
soon draws little enough to be believed again."""
_STALLED = 3.0
"""Multiples of the current of the stalled motor above which a reading is none: driven backwards at full speed it draws
twice that."""
TOO_OLD = "motor/state or motor/current is too old: 0 V"
_ZERO = convert.float64_bytes(0.0)
_INPUTS = ("encoder_position", "motor_current", "reference_position")
_TOPICS = tuple(topics.signal(name).topic for name in _INPUTS)


@dataclass(frozen=True)
class MotorControllerParameters:
    """ROS parameters of motor_controller."""

    model: str = parameter("nominal", "model whose gains and limits are used: name or path of a model file")
    clock: str = parameter("realtime", CLOCK_HELP, choices=CLOCKS)
    period: float = parameter(1e-3, "control period", lower=1e-4, upper=1e-1, unit="s")
    autostart: bool = parameter(
        True, "configure and activate at start; otherwise wait for the lifecycle services"
    )
    reference: str = parameter(
        "topic",
        "topic, or a profile of its own from the first state and current after activation on",
        choices=("topic", *PROFILES),
    )
    reference_closures: int = parameter(1, "closures of the profile", lower=1, upper=100000)
    reference_amplitude: float = parameter(
        FULL_CLOSURE, "amplitude of the profile", lower=1e-3, upper=100.0, unit="rad"
    )
    reference_period: float = parameter(
        0.0, "period of the profile, 0 for its own", lower=0.0, upper=1e3, unit="s"
    )
    reference_subscribers: int = parameter(
        0, "subscribers that the reference must have before a profile of its own begins", lower=0, upper=100
    )
    subscribers: int = parameter(
        1, "subscribers that motor/voltage must have before the first answer in lockstep", lower=1, upper=100
    )
    state_timeout_ms: float = parameter(
        50.0,
        "age of motor/state or motor/current from which the command is 0 V",
        lower=1.0,
        upper=1e4,
        unit="ms",
    )
    pause_limit_ms: float = parameter(
        100.0,
        "a pause of the control loop longer than this deactivates the node",
        lower=1.0,
        upper=1e4,
        unit="ms",
    )

    def profile(self) -> Profile | None:
        """The profile (n,) in rad, None for the topic."""
        if self.reference == "topic":
            return None
        options = {"period": self.reference_period} if self.reference_period > 0.0 else {}
        return make_profile(
            self.reference,
            closures=self.reference_closures,
            amplitude=self.reference_amplitude,
            dt=self.period,
            **options,
        )


class MotorController(HannesNode, LifecycleNode):
    """Drives the motor to the reference position; commands only while active."""

    node_name = "motor_controller"
    parameters = MotorControllerParameters

    def __init__(self, cli_args: list[str] | None = None) -> None:
        super().__init__(self.node_name, namespace=DEFAULT_NAMESPACE, cli_args=cli_args)
        self._p = p = declare(self, MotorControllerParameters)
        model = Model.load(p.model)
        if model.controller != "double_pid":
            raise HannesError(
                f"Model '{model.name}' asks for the controller '{model.controller}'; this node runs "
                "double_pid only."
            )
        self._pid = DoublePID.of_model(model.parameters, p.period)
        tell(self, {"control_period": p.period, LOOP: loop_of(model)})
        self._limit = self._pid.settings.voltage_limit
        self._profile = p.profile()
        if self._profile is not None:
            check_travel(p.reference_amplitude, model.parameters)
        self._travel = travel_of(model.parameters)
        values = model.parameters
        self._most_current = (
            _STALLED * values.value("supply.voltage") / values.value("motor.resistance")
            if {"supply.voltage", "motor.resistance"} <= set(values)
            else math.inf
        )
        self._lockstep = p.clock == "lockstep"
        self._active = self._tripped = False
        self._impossible = 0
        self._health = Health(
            "rejected_states",
            "rejected_inputs",
            "limited_references",
            "state_timeouts",
            "trips",
            "resets",
            "rejoins",
        )
        self._arrivals = Arrivals()
        self._state: convert.JointSample | None = None
        self._current: float | None = None
        self._reference: float | None = None
        self._state_at = self._current_at = self._reference_at = 0.0
        self._stale = self._said_stale = False
        self._late_since: float | None = None
        self._waits_since: float | None = None
        self._reported = 0
        self._played = -1
        self._answered = self._heard = -1
        self._period_ns = round(p.period * 1e9)
        self._join = TickJoin(2 if self._profile is not None else 3)
        self._loop: RealtimeLoop | None = None
        self._missed = 0

        self._sources = Sources(self, *_INPUTS[: 3 if self._profile is None else 2])
        self._probe = Probe(self._sources.mixed)
        heard = self._probe.on_match
        self._voltage = topics.publisher(self, "motor_voltage")
        topics.subscription(
            self, "motor_current", self._on_tick_current if self._lockstep else self._on_current, heard
        )
        # who records wants the reference on its topic, wherever it comes from
        self._own_reference = None if self._profile is None else topics.publisher(self, "reference_position")
        if self._profile is None:
            topics.subscription(
                self,
                "reference_position",
                self._on_tick_reference if self._lockstep else self._on_reference,
                heard,
            )
        # Last: hand_sim starts once it has found who hears this, who then hears the rest too.
        topics.subscription(
            self, "encoder_position", self._on_tick_state if self._lockstep else self._on_state, heard
        )
        hearers = [("motor_voltage", self._voltage, p.subscribers)] if self._lockstep else []
        if self._own_reference is not None:
            hearers.append(("reference_position", self._own_reference, p.reference_subscribers))
        self._peers = Peers(
            {
                f"{least} subscriber(s) of {topics.signal(name).topic}": (
                    output.get_subscription_count,
                    least,
                )
                for name, output, least in hearers
            }
        )
        self._diagnostics = Diagnostics(self, self._health, self._status)
        self.wall_timer(_CHECK_S, self._check)
        if p.autostart:
            self.trigger_configure()
            self.trigger_activate()

    # -- life cycle --------------------------------------------------------------------------------------------------
    def _LifecycleNodeMixin__change_state(self, transition_id: int) -> TransitionCallbackReturn:
        """rclpy's way into every transition: by the service and by `trigger_*`.

        Where the state does not allow the transition rclpy raises, which would end the node; here it is a failure.
        """
        try:
            return super()._LifecycleNodeMixin__change_state(transition_id)  # type: ignore[misc]
        except rclpy_implementation.RCLError:
            self.get_logger().warning(
                f"transition {transition_id} is not possible in this state: nothing done"
            )
            return TransitionCallbackReturn.FAILURE

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Ready, motor off."""
        self._pid.reset()
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Motor on, from a cleared controller."""
        self._clear()
        self._active, self._tripped, self._impossible = True, False, 0
        if self._lockstep:
            if self._join.synchronised:
                self._answer()
        else:
            self._played = -1
            self._loop = RealtimeLoop(self._p.period, self._step)
            self._loop.start()
        return TransitionCallbackReturn.SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Motor off, integrators cleared."""
        self._off()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Motor off."""
        self._off()
        return TransitionCallbackReturn.SUCCESS

    def stop(self) -> None:
        """Motor off; the process ends."""
        self._off()

    def _off(self) -> None:
        was_active, self._active = self._active, False
        if self._loop is not None:
            self._loop.stop()
            self._missed += self._loop.missed
            self._loop = None
        if was_active and not self._lockstep:
            self._voltage.publish(_ZERO)
        self._clear()

    def _clear(self) -> None:
        self._pid.reset()
        self._health.count("resets")

    # -- the law -----------------------------------------------------------------------------------------------------
    def _command(self, reference: float | None, position: float, current: float) -> float:
        """Voltage (V), clamped; a sensor that is not finite, or beyond what the hand has, gives 0 V and a cleared
        controller, no reference 0 V."""
        if reference is None:
            return 0.0
        if not (self._is_place(position) and self._is_drawn(current)):
            self._clear()
            return 0.0
        try:
            voltage = self._pid.update(reference, position, current)
        except HannesError:
            self._clear()
            return 0.0
        return min(max(voltage, -self._limit), self._limit)

    def _decode(self, data: bytes) -> convert.JointSample | None:
        try:
            sample = convert.MOTOR_STATE.decode(data)
        except HannesError as error:
            self._reject_state(ERROR, str(error))
            return None
        name, position = "position of motor/state", sample.position[0]
        if self._finite(name, position, ERROR, "0 V"):
            most = 2.0 * self._travel
            self._possible(
                name,
                self._is_place(position),
                f"{position:g} rad",
                f"{-self._travel:g} .. {most:g} rad: in rad?",
            )
        return sample

    def _reject_state(self, level: bytes, why: str) -> None:
        self._health.count("rejected_states")
        self._health.faults.bad("motor/state", level, f"motor/state is rejected: {why}")

    def _decode_current(self, data: bytes) -> float:
        current = convert.float64_value(data)
        if self._finite("motor/current", current, ERROR, "0 V"):
            self._possible(
                "motor/current",
                self._is_drawn(current),
                f"{current:g} A",
                f"{self._most_current:.3g} A: in A?",
            )
        return current

    def _is_place(self, position: float) -> bool:
        """Whether the hand can be there: its encoder may be zeroed anywhere along its way."""
        return not (position < -self._travel or position > 2.0 * self._travel)

    def _is_drawn(self, current: float) -> bool:
        return not abs(current) > self._most_current

    def _possible(self, name: str, is_so: bool, value: str, most: str) -> None:
        """Count and report an input that no hand gives: one in another unit would be driven against."""
        if is_so:
            self._health.faults.good(f"{name}, its range")
            return
        self._health.count("rejected_inputs")
        self._impossible += 1
        self._health.faults.bad(
            f"{name}, its range", ERROR, f"{name} of {value} is beyond what this hand has, {most} 0 V"
        )

    def _decode_reference(self, data: bytes) -> float | None:
        """The reference (rad) from here on: within the hand's travel, beyond which the motor would stall or unwind.

        One that is not finite leaves the last good one, None if there was none.
        """
        value = convert.float64_value(data)
        instead = "0 V" if self._reference is None else "the last good one holds"
        if self._finite("reference_position", value, WARN, instead):
            self._reference, self._reference_at = self._limited(value), monotonic()
        return self._reference

    def _limited(self, reference: float) -> float:
        limited = min(max(reference, 0.0), self._travel)
        if abs(reference - limited) <= RAD_PER_COUNT:  # rounding
            self._health.faults.good("travel")
            return reference
        self._health.count("limited_references")
        self._health.faults.bad(
            "travel",
            WARN,
            f"reference_position of {reference:g} rad is limited to 0 .. {self._travel:g} rad, the travel of the hand",
        )
        return limited

    def _finite(self, name: str, value: float, level: bytes, instead: str) -> bool:
        """Whether an input is finite; if not it is counted and reported, with what is done instead."""
        if math.isfinite(value):
            self._health.faults.good(name)
            return True
        self._health.count("rejected_inputs")
        self._health.faults.bad(name, level, f"{name} is not finite ({value}): {instead}")
        return False

    def _profile_at(self, tick: int) -> float:
        assert self._profile is not None and self._own_reference is not None
        reference = float(self._profile[min(max(tick, 0), self._profile.size - 1)])
        self._own_reference.publish(convert.float64_bytes(reference))
        return reference

    # -- real time ---------------------------------------------------------------------------------------------------
    def _on_state(self, data: bytes) -> None:
        sample = self._decode(data)
        if sample is None:
            return
        age = (self.get_clock().now().nanoseconds - sample.stamp_ns) * 1e-9
        if abs(age) > self._p.state_timeout_ms / 1e3:
            now = monotonic()
            self._late_since = now if self._late_since is None else self._late_since
            if abs(age) > _ANOTHER_CLOCK_S or now - self._late_since > _ANOTHER_CLOCK_S:
                self._reject_state(ERROR, self._wrong_stamp(sample.stamp_ns, age))
            else:  # a busy machine
                self._health.count("rejected_states")
            return
        self._late_since = None
        if self._state is not None and sample.stamp_ns <= self._state.stamp_ns and not self._stale:
            self._reject_state(WARN, "its stamp is not later than the one before")
            return
        self._health.faults.good("motor/state")
        self._state, self._state_at = sample, monotonic()
        self._arrivals.came(self._state_at)

    def _wrong_stamp(self, stamp_ns: int, age: float) -> str:
        """What is wrong with a stamp that is `age` s old, or ahead where that is negative."""
        if self.get_clock().ros_time_is_active:
            clock = "/clock (use_sim_time)"
        else:
            clock = "the clock of this machine (for a played bag set use_sim_time)"
        if not stamp_ns:
            return f"its header has no stamp; set it by {clock}"
        side = "before" if age > 0.0 else "after"
        allowed = self._p.state_timeout_ms / 1e3
        return f"it is stamped {abs(age):.3g} s {side} {clock}; {allowed:g} s are allowed"

    def _on_current(self, data: bytes) -> None:
        self._current, self._current_at = self._decode_current(data), monotonic()

    def _on_reference(self, data: bytes) -> None:
        self._decode_reference(data)

    def _step(self, now: float, elapsed: int) -> None:
        """One period of the real-time thread."""
        if not self._active or self._tripped:
            return
        if elapsed * self._p.period * 1e3 > self._p.pause_limit_ms:
            self._tripped = True
            return
        if self._state is None or self._current is None or self._peers.missing():
            self._missed -= elapsed - 1  # nothing was to be done in them
            return
        if now - min(self._state_at, self._current_at) > self._p.state_timeout_ms / 1e3:
            if not self._stale:
                self._stale = True
                self._health.count("state_timeouts")
                self._clear()
            voltage = 0.0
        else:
            self._stale = False
            # a profile begins with the first period that has live sensors, and stands while they are stale
            self._played += elapsed if self._played >= 0 else 1
            reference = self._reference if self._profile is None else self._profile_at(self._played)
            voltage = self._command(reference, self._state.position[0], self._current)
        self._voltage.publish(convert.float64_bytes(voltage))
        self._health.cycles += 1

    # -- lock-step ---------------------------------------------------------------------------------------------------
    def _on_tick_state(self, data: bytes) -> None:
        sample = self._decode(data)
        if sample is None:
            return
        self._health.faults.good("motor/state")
        jumps = 0 <= self._heard < sample.stamp_ns - self._period_ns
        if (jumps or (self._probe.held and sample.stamp_ns != self._heard)) and self._sources.mixed():
            # No simulator leaves out ticks, or begins again while its tick is held.
            self.fail(self._sources.surplus("encoder_position"))
            return
        if sample.stamp_ns < self._answered:  # the simulator began again
            self._join.reset()
            self._answered = self._heard = -1
            self._reference = None
            self._clear()
        elif sample.stamp_ns == self._heard:  # repeated to a newcomer
            self._join.rejoin()
        self._heard = sample.stamp_ns
        self._put(0, sample)
        self._arrivals.came(self._state_at)

    def _on_tick_current(self, data: bytes) -> None:
        self._put(1, self._decode_current(data))

    def _on_tick_reference(self, data: bytes) -> None:
        self._put(2, self._decode_reference(data))

    def _put(self, slot: int, item: object) -> None:
        self._state_at = monotonic()
        self._join.put(slot, item)
        if self._join.synchronised:
            self._answer()
        if self._join.surplus is not None:
            self._on_surplus(self._join.surplus)

    def _on_surplus(self, slot: int) -> None:
        """Messages of another source end the node; what one source repeated too late for `rejoin` is joined anew."""
        name = _INPUTS[slot]
        if slot == 0 and self._join.synchronised:
            name = "motor_voltage"  # somebody else has answered, or the next motor/state would not be there
        if not self._join.synchronised or self._sources.count(name) > 1:
            self.fail(self._sources.surplus(name))
            return
        self._health.count("rejoins")
        self.get_logger().warning(f"{topics.signal(name).topic} is ahead of the ticks: joined anew")
        self._join.rejoin()

    def _answer(self) -> None:
        """Answer the tick if all of it is here, the motor is on and the answer will be heard."""
        while self._active and self._peers.complete and self._join.complete:
            if self._join.synchronised and self._probe.holds():
                return
            tick = self._join.take()
            assert tick is not None
            sample, current = tick[0], tick[1]
            if sample.stamp_ns == self._answered:
                continue
            step_ns = sample.stamp_ns - self._answered
            if self._answered >= 0 and step_ns != self._period_ns:
                self.fail(
                    f"motor/state comes every {step_ns * 1e-9:g} s, but the control period is "
                    f"{self._p.period:g} s; give hand_sim and motor_controller the same period"
                    + (f" ({several})." if (several := self._sources.several()) else ".")
                )
                return
            reference = (
                tick[2] if self._profile is None else self._profile_at(sample.stamp_ns // self._period_ns)
            )
            self._answered = sample.stamp_ns
            if not self._join.synchronised:
                self._join.synchronise()
                self._probe.due = True
            self._health.cycles += 1
            self._voltage.publish(
                convert.float64_bytes(self._command(reference, sample.position[0], current))
            )

    # -- health ------------------------------------------------------------------------------------------------------
    def _check(self) -> None:
        stale = self._active and self._stale
        if stale and not self._said_stale:
            self.get_logger().error(TOO_OLD, throttle_duration_sec=SAY_AGAIN_S)
        self._said_stale = stale
        if self._lockstep and self._probe.over() and self._join.synchronised:
            if (left_over := self._join.left_over) is not None:
                self._on_surplus(left_over)
            else:
                self._answer()
        if (
            self._lockstep
            and not self._peers.missing()
            and not self._join.synchronised
            and monotonic() - self._state_at >= SETTLE_S
        ):
            self._answer()
        if self._loop is not None and self._loop.error is not None:
            self.fail(f"The control loop stopped: {self._loop.error!r}")
        if self._impossible >= _MOST_IMPOSSIBLE and self._active and not self._lockstep:
            self._tripped = True
            self._switch_off(
                f"{self._impossible} readings that no hand gives: motor off; mend what the board sends"
            )
        elif self._tripped and self._active:
            self._switch_off(
                f"the control loop paused for more than {self._p.pause_limit_ms:g} ms: motor off"
            )

    def _switch_off(self, why: str) -> None:
        """The motor off until somebody activates the node again."""
        self._health.count("trips")
        self.get_logger().error(f"{why}; activate the node again")
        self.trigger_deactivate()
        self._diagnostics.publish()

    def _state_rate(self) -> str:
        """Rate of motor/state; in real time too low a one is a fault."""
        rate = self._arrivals.rate()
        if rate is None or rate >= _SLOWEST_STATE_HZ or self._lockstep:
            self._health.faults.good("rate")
        else:
            said = (
                f"motor/state comes at {rate:.0f} Hz: the loop needs 100 Hz, or it oscillates; best is 1 kHz"
            )
            self._health.faults.bad("rate", WARN, said)
        return "" if rate is None else f"{rate:.1f}"

    def _status(self) -> tuple[bytes, str, dict[str, object]]:
        self._health.last_input = self._state_at or None
        age = f"{monotonic() - self._reference_at:.3f}" if self._reference_at else ""
        self._health.missed = self._missed + (self._loop.missed if self._loop else 0)
        values: dict[str, object] = {
            "active": self._active,
            "battery_saver": self._pid.saving,
            "reference_age_s": age,
            "state_rate_hz": self._state_rate(),
        }
        if several := self._sources.several():
            return ERROR, several, values
        if not self._active:
            return WARN, "not active: motor off" + ("; activate again" if self._tripped else ""), values
        if self._lockstep and (absent := self._peers.missing()):
            return WARN, f"waiting for {', '.join(absent)}", values
        if self._lockstep:
            # Within a tick something is missing always: what counts is whether none was answered since the last report.
            answered, self._reported = self._health.cycles > self._reported, self._health.cycles
            missing = [] if answered else [_TOPICS[slot] for slot in self._join.missing()]
            level = WARN if self._state_at and silence({"any message": self._state_at}) else OK
            return (
                (level, f"waiting for {', '.join(missing)}", values) if missing else (OK, "running", values)
            )
        if self._stale:
            return ERROR, TOO_OLD, values
        absent = [
            name
            for name, value in zip(
                _TOPICS,
                (self._state, self._current, self._reference if self._profile is None else 0.0),
                strict=True,
            )
            if value is None and name not in self._health.faults
        ] + self._peers.missing()
        if absent:
            waiting, now = f"waiting for {', '.join(absent)}", monotonic()
            self._waits_since = self._waits_since or now
            if now - self._waits_since > _PATIENCE_S:
                self.get_logger().warning(waiting + not_beyond(), throttle_duration_sec=30.0)
            return WARN, waiting, values
        self._waits_since = None
        if self._profile is None and (silent := silence({"reference_position": self._reference_at})):
            return WARN, f"{silent}: the last one is held", values
        return OK, "running", values


def main() -> None:
    """Run the node."""
    sys.exit(run_node("hannes_control.motor_controller_node:MotorController"))


if __name__ == "__main__":
    main()
