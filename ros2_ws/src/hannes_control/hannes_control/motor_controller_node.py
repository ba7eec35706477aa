"""motor_controller: the double PID as a lifecycle node; state, current and reference in, motor/voltage out."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from time import monotonic

import hannes_ros.early  # noqa: F401  (signals are safe from here on)
import numpy as np
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_ros import topics
from hannes_ros.diagnostics import ERROR, WARN, Diagnostics, Health
from hannes_ros.lockstep import Peers
from hannes_ros.node import CLOCK_HELP, CLOCKS, DEFAULT_NAMESPACE, HannesNode
from hannes_ros.node_parameters import declare, parameter
from hannes_ros.run import run_node
from hannes_ros.sources import Sources
from hannes_ros.telling import LOOP, loop_of, tell
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.publisher import Publisher

from .double_pid import DoublePID
from .nodes.lockstep_control import LockstepControl
from .nodes.motor_drive import MotorDrive
from .nodes.motor_inputs import INPUTS, MotorInputs
from .nodes.realtime_control import RealtimeControl
from .reference import FULL_CLOSURE, PROFILES, Profile, check_travel, make_profile

_CHECK_S = 0.02


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
    reference_rest: float = parameter(
        0.0,
        "rest before the profile: a recording begins before what it records",
        lower=0.0,
        upper=1e3,
        unit="s",
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
        moves = make_profile(
            self.reference,
            closures=self.reference_closures,
            amplitude=self.reference_amplitude,
            dt=self.period,
            **options,
        )
        return np.concatenate([np.full(round(self.reference_rest / self.period), moves[0]), moves])


class MotorController(HannesNode, LifecycleNode):
    """Drives the motor to the reference position; commands only while active."""

    node_name = "motor_controller"
    parameters = MotorControllerParameters

    def __init__(self, cli_args: list[str] | None = None) -> None:
        super().__init__(self.node_name, namespace=DEFAULT_NAMESPACE, cli_args=cli_args)
        p = declare(self, MotorControllerParameters)
        model = Model.load(p.model)
        if model.controller != "double_pid":
            raise HannesError(
                f"Model '{model.name}' asks for the controller '{model.controller}'; this node runs "
                "double_pid only."
            )
        pid = DoublePID.of_model(model.parameters, p.period)
        tell(self, {"control_period": p.period, LOOP: loop_of(model)})
        profile = p.profile()
        if profile is not None:
            check_travel(p.reference_amplitude, model.parameters)
        self._health = Health(
            "rejected_states",
            "rejected_inputs",
            "limited_references",
            "state_timeouts",
            "trips",
            "resets",
            "rejoins",
        )
        self._inputs = MotorInputs(model.parameters, self._health)
        heard = INPUTS if profile is None else INPUTS[:2]
        self._sources = Sources(self, *heard)
        voltage = topics.publisher(self, "motor_voltage")
        shown = None if profile is None else topics.publisher(self, "reference_position")
        show = None if shown is None else shown.publish
        self._drive = MotorDrive(pid, self._inputs, profile, self._health, voltage.publish, show)
        self._control = self._made(p, _hearers(p, voltage, shown))
        callbacks = {
            "motor_current": self._control.on_current,
            "reference_position": self._control.on_reference,
            # Last: hand_sim starts once it has found who hears this, who then hears the rest too.
            "encoder_position": self._control.on_state,
        }
        for name, callback in callbacks.items():
            if name in heard:
                topics.subscription(self, name, callback, self._control.heard)
        self._diagnostics = Diagnostics(self, self._health, self._status)
        self.wall_timer(_CHECK_S, self._check)
        if p.autostart:
            self.trigger_configure()
            self.trigger_activate()

    def _made(self, p: MotorControllerParameters, hearers: Peers) -> RealtimeControl | LockstepControl:
        """What drives the motor by the clock of the parameters."""
        if p.clock == "lockstep":
            return LockstepControl(self, self._drive, self._sources, hearers, period=p.period)
        return RealtimeControl(
            self,
            self._drive,
            hearers,
            period=p.period,
            timeout=p.state_timeout_ms / 1e3,
            pause=p.pause_limit_ms / 1e3,
        )

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
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Motor on, from a cleared controller."""
        self._drive.clear()
        self._control.on()
        return TransitionCallbackReturn.SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Motor off, integrators cleared."""
        self.stop()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Motor off."""
        self.stop()
        return TransitionCallbackReturn.SUCCESS

    def stop(self) -> None:
        """Motor off, integrators cleared."""
        self._control.off()
        self._drive.clear()

    # -- health ------------------------------------------------------------------------------------------------------
    def _check(self) -> None:
        if why := self._control.check():
            self._switch_off(why)

    def _switch_off(self, why: str) -> None:
        """The motor off until somebody activates the node again."""
        self._health.count("trips")
        self.get_logger().error(f"{why}; activate the node again")
        self.trigger_deactivate()
        self._diagnostics.publish()

    def _status(self) -> tuple[bytes, str, dict[str, object]]:
        control, inputs = self._control, self._inputs
        self._health.last_input = control.last_input or None
        self._health.missed = control.missed
        rate = control.state_rate()
        values: dict[str, object] = {
            "active": control.active,
            "battery_saver": self._drive.saving,
            "reference_age_s": f"{monotonic() - inputs.reference_at:.3f}" if inputs.reference_at else "",
            "state_rate_hz": "" if rate is None else f"{rate:.1f}",
        }
        if several := self._sources.several():
            return ERROR, several, values
        if not control.active:
            return WARN, "not active: motor off" + ("; activate again" if control.tripped else ""), values
        return *control.status(), values


def _hearers(p: MotorControllerParameters, voltage: Publisher, shown: Publisher | None) -> Peers:
    """Who must be there before the first answer in lock-step, and before a profile of its own begins."""
    hearers = [("motor_voltage", voltage, p.subscribers)] if p.clock == "lockstep" else []
    if shown is not None:
        hearers.append(("reference_position", shown, p.reference_subscribers))
    return Peers(
        {
            f"{least} subscriber(s) of {topics.signal(name).topic}": (output.get_subscription_count, least)
            for name, output, least in hearers
        }
    )


def main() -> None:
    """Run the node."""
    sys.exit(run_node("hannes_control.motor_controller_node:MotorController"))


if __name__ == "__main__":
    main()
