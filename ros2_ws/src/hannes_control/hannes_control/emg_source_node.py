"""emg_source: two channels of surface EMG as topics, synthetic or from a CSV file."""

from __future__ import annotations

import sys
from dataclasses import dataclass

import hannes_ros.early  # noqa: F401  (signals are safe from here on)
from hannes_description.errors import HannesError
from hannes_ros import convert, topics
from hannes_ros.diagnostics import OK, WARN, Diagnostics, Health
from hannes_ros.lockstep import Peers, samples_until
from hannes_ros.loop import RealtimeLoop
from hannes_ros.node import CLOCK_HELP, CLOCKS, DEFAULT_NAMESPACE, HannesNode
from hannes_ros.node_parameters import declare, parameter
from hannes_ros.run import run_node
from rclpy.node import Node
from rclpy.subscription import Subscription

from .emg import EmgRecording, SyntheticEmg, read_emg_csv, synthesise

_CHECK_S = 0.02


@dataclass(frozen=True)
class EmgSourceParameters:
    """ROS parameters of emg_source."""

    file: str = parameter("", "CSV file with columns t_s, close, open; empty for synthetic EMG")
    rate: int = parameter(
        300, "rate of the samples; a file of another rate is resampled", lower=100, upper=2000, unit="Hz"
    )
    clock: str = parameter("realtime", CLOCK_HELP, choices=CLOCKS)
    subscribers: int = parameter(
        1, "subscribers that each channel must have before the first sample in lockstep", lower=1, upper=100
    )
    seed: int = parameter(0, "seed of the synthetic EMG", lower=0, upper=2**31)
    begin: str = parameter(
        "at_once",
        "when the samples begin in real time: at_once, or driven: with the first motor/voltage, rest (0 V) before it",
        choices=("at_once", "driven"),
    )
    closures: int = parameter(1, "closures of the synthetic EMG", lower=1, upper=100000)
    close_time: float = parameter(1.6, "contraction of the flexor", lower=0.1, upper=100.0, unit="s")
    hold_time: float = parameter(1.0, "rest between closing and opening", lower=0.0, upper=100.0, unit="s")
    open_time: float = parameter(1.6, "contraction of the extensor", lower=0.1, upper=100.0, unit="s")
    rest_time: float = parameter(0.8, "rest after opening", lower=0.0, upper=100.0, unit="s")
    cocontraction_time: float = parameter(
        0.0, "contraction of both after each closure", lower=0.0, upper=100.0, unit="s"
    )
    amplitude: float = parameter(
        1.0, "mean rectified value of a full contraction", lower=1e-6, upper=100.0, unit="V"
    )

    def recording(self) -> EmgRecording:
        """The samples to play, at `rate`."""
        if self.file:
            return read_emg_csv(self.file).resampled(self.rate)
        protocol = SyntheticEmg(
            closures=self.closures,
            close=self.close_time,
            hold=self.hold_time,
            open=self.open_time,
            rest=self.rest_time,
            cocontraction=self.cocontraction_time,
            amplitude=self.amplitude,
            noise=0.02 * self.amplitude,
        )
        return synthesise(protocol, self.seed, self.rate)


class EmgSource(HannesNode, Node):
    """Plays two EMG channels once, then rest (0 V)."""

    node_name = "emg_source"
    parameters = EmgSourceParameters

    def __init__(self, cli_args: list[str] | None = None) -> None:
        super().__init__(self.node_name, namespace=DEFAULT_NAMESPACE, cli_args=cli_args)
        self._p = p = declare(self, EmgSourceParameters)
        self._recording = recording = p.recording()
        self._size = recording.flexor.size
        self._sent = 0
        self._until = 0
        self._stamp = -1
        self._health = Health("rejected_states")
        self._flexor = topics.publisher(self, "emg_flexor")
        self._extensor = topics.publisher(self, "emg_extensor")
        self._lockstep = p.clock == "lockstep"
        self._peers = Peers(
            {
                f"{p.subscribers} subscriber(s) of emg/flexor": (
                    self._flexor.get_subscription_count,
                    p.subscribers,
                ),
                f"{p.subscribers} subscriber(s) of emg/extensor": (
                    self._extensor.get_subscription_count,
                    p.subscribers,
                ),
            }
        )
        self._loop = RealtimeLoop(1.0 / p.rate, self._step)
        self._diagnostics = Diagnostics(self, self._health, self._status)
        self.wall_timer(_CHECK_S, self._check)
        self._driven: Subscription | None = None
        self._waits = False
        if self._lockstep:
            topics.subscription(self, "encoder_position", self._on_tick_state)
        else:
            if p.begin == "driven":
                self._waits = True
                self._driven = topics.subscription(self, "motor_voltage", self._on_voltage)
            self._loop.start()
        self.get_logger().info(f"{p.file or 'synthetic EMG'}: {recording.duration:.1f} s at {p.rate} Hz")

    def stop(self) -> None:
        """End the real-time loop."""
        self._loop.stop()

    def _send(self, until: int) -> None:
        """Publish the samples before number `until` that were not sent yet."""
        while self._sent < until:
            if self._sent < self._size:
                emg, k = self._recording, self._sent
                self._publish(float(emg.flexor[k]), float(emg.extensor[k]))
            else:
                self._publish(0.0, 0.0)
            self._sent += 1

    def _publish(self, flexor: float, extensor: float) -> None:
        self._flexor.publish(convert.float64_bytes(flexor))
        self._extensor.publish(convert.float64_bytes(extensor))
        self._health.cycles += 1

    def _step(self, now: float, elapsed: int) -> None:
        if self._waits:
            for _ in range(elapsed):
                self._publish(0.0, 0.0)
        else:
            self._send(self._sent + elapsed)

    def _on_voltage(self, data: bytes) -> None:
        """The loop is closed: somebody drives the motor."""
        self._waits = False

    def _on_tick_state(self, data: bytes) -> None:
        """In lock-step the samples follow the stamps of motor/state."""
        try:
            stamp_ns = convert.MOTOR_STATE.decode(data).stamp_ns
        except HannesError as error:
            self._health.count("rejected_states")
            self.get_logger().error(f"motor/state is rejected: {error}", throttle_duration_sec=5.0)
            return
        if stamp_ns < self._stamp:  # the simulator began again
            self._sent = 0
        self._stamp, self._until = stamp_ns, samples_until(stamp_ns, self._p.rate)
        if self._peers.complete:
            self._send(self._until)

    def _check(self) -> None:
        if self._lockstep and not self._peers.complete and not self._peers.missing():
            self._send(self._until)
        if self._driven is not None and not self._waits:
            self.destroy_subscription(self._driven)
            self._driven = None
        if self._loop.error is not None:
            self.fail(f"The EMG stopped: {self._loop.error!r}")

    def _status(self) -> tuple[bytes, str, dict[str, object]]:
        self._health.missed = self._loop.missed
        values: dict[str, object] = {"samples": self._size, "sent": self._sent}
        if self._lockstep and (missing := self._peers.missing()):
            return WARN, f"waiting for {', '.join(missing)}", values
        if self._waits:
            return WARN, "rest, waiting for motor/voltage: nobody drives the motor yet", values
        return OK, "running" if self._sent < self._size else "played to the end: rest", values


def main() -> None:
    """Run the node."""
    sys.exit(run_node("hannes_control.emg_source_node:EmgSource"))


if __name__ == "__main__":
    main()
