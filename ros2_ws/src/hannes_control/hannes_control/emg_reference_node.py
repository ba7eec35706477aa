"""emg_reference: two EMG channels in, the reference of the encoder position out."""

from __future__ import annotations

import math
import sys
from collections import deque
from dataclasses import dataclass
from functools import partial
from time import monotonic

import hannes_ros.early  # noqa: F401  (signals are safe from here on)
from hannes_description.errors import HannesError
from hannes_ros import convert, topics
from hannes_ros.diagnostics import ERROR, OK, WARN, Arrivals, Diagnostics, Health, silence
from hannes_ros.lockstep import Peers, Probe, samples_until
from hannes_ros.node import CLOCK_HELP, CLOCKS, DEFAULT_NAMESPACE, HannesNode
from hannes_ros.node_parameters import declare, parameter
from hannes_ros.run import run_node
from hannes_ros.sources import Sources
from rclpy.node import Node

from .emg import EmgIntegrator, EmgParameters

_CHECK_S = 0.02
_DEFAULT = EmgParameters()
_CHANNELS = ("emg_flexor", "emg_extensor")
_TOPICS = tuple(topics.signal(name).topic for name in _CHANNELS)
_RATE_OFF = 0.1
"""Part of its rate by which a channel may differ from it: samples are counted, each for 1 / rate."""

_LONGEST_QUEUE = 1000
"""Samples of a channel that wait for the other channel or their tick, at most; its topic holds fewer."""


@dataclass(frozen=True)
class EmgReferenceParameters:
    """ROS parameters of emg_reference; see EmgParameters for their meaning."""

    clock: str = parameter("realtime", CLOCK_HELP, choices=CLOCKS)
    subscribers: int = parameter(
        1,
        "subscribers that reference_position must have before the first answer in lockstep",
        lower=1,
        upper=100,
    )
    rate: int = parameter(int(_DEFAULT.rate), "rate of both channels", lower=100, upper=2000, unit="Hz")
    full_scale: float = parameter(
        _DEFAULT.full_scale,
        "envelope of a full contraction; thresholds are fractions of it",
        lower=1e-9,
        upper=1e6,
        unit="V",
    )
    envelope_cutoff: float = parameter(
        _DEFAULT.envelope_cutoff, "low-pass of the rectified signal", lower=0.1, upper=45.0, unit="Hz"
    )
    dead_band: float = parameter(_DEFAULT.dead_band, "envelope of zero speed", lower=0.0, upper=1.0)
    close_threshold: float = parameter(
        _DEFAULT.close_threshold, "flexor envelope that closes", lower=0.0, upper=10.0
    )
    open_threshold: float = parameter(
        _DEFAULT.open_threshold, "extensor envelope that opens", lower=0.0, upper=10.0
    )
    speed: float = parameter(
        _DEFAULT.speed, "speed of a full contraction", lower=1e-3, upper=1e3, unit="rad/s"
    )
    max_speed: float = parameter(
        _DEFAULT.max_speed, "limit of the speed", lower=1e-3, upper=1e3, unit="rad/s"
    )
    max_position: float = parameter(
        _DEFAULT.max_position, "largest reference", lower=1e-3, upper=100.0, unit="rad"
    )
    cocontraction_threshold: float = parameter(
        _DEFAULT.cocontraction_threshold,
        "both envelopes above it: a switch event, no movement",
        lower=0.0,
        upper=10.0,
    )
    cocontraction_time: float = parameter(
        _DEFAULT.cocontraction_time, "how long both must stay above it", lower=0.0, upper=10.0, unit="s"
    )

    def emg(self) -> EmgParameters:
        """The same values as the core takes them."""
        return EmgParameters(**{name: getattr(self, name) for name in EmgParameters.__dataclass_fields__})


class EmgReferenceNode(HannesNode, Node):
    """Turns muscle signals into a position reference; in lock-step exactly one for each motor/state."""

    node_name = "emg_reference"
    parameters = EmgReferenceParameters

    def __init__(self, cli_args: list[str] | None = None) -> None:
        super().__init__(self.node_name, namespace=DEFAULT_NAMESPACE, cli_args=cli_args)
        self._p = p = declare(self, EmgReferenceParameters)
        self._emg = EmgIntegrator(p.emg())
        self._channels: tuple[deque[float], deque[float]] = (
            deque(maxlen=_LONGEST_QUEUE),
            deque(maxlen=_LONGEST_QUEUE),
        )
        self._held = [0.0, 0.0]
        self._heard: dict[str, float] = {}
        self._arrivals = tuple(Arrivals() for _ in _CHANNELS)
        self._rate_off = False
        self._waiting = [_LONGEST_QUEUE, _LONGEST_QUEUE]
        self._taken = 0
        self._stamp = -1
        self._ticks: deque[int] = deque(maxlen=_LONGEST_QUEUE)
        self._switches = 0
        self._health = Health("rejected_samples", "rejected_states", "dropped_samples")
        self._reference = topics.publisher(self, "reference_position")
        self._lockstep = p.clock == "lockstep"
        self._peers = Peers(
            {
                f"{p.subscribers} subscriber(s) of reference_position": (
                    self._reference.get_subscription_count,
                    p.subscribers,
                )
            }
        )
        self._sources = Sources(self, *_CHANNELS, *(("encoder_position",) if self._lockstep else ()))
        self._probe = Probe(self._sources.mixed)
        for number, name in enumerate(_CHANNELS):
            topics.subscription(self, name, partial(self._on_emg, number), self._probe.on_match)
        if self._lockstep:
            topics.subscription(self, "encoder_position", self._on_tick_state)
            self.wall_timer(_CHECK_S, self._check)
        self._diagnostics = Diagnostics(self, self._health, self._status)

    def _on_emg(self, number: int, data: bytes) -> None:
        value = convert.float64_value(data)
        if math.isfinite(value):
            self._held[number] = value
        else:
            self._health.count("rejected_samples")
        self._channels[number].append(self._held[number])
        self._heard[_TOPICS[number]] = self._health.last_input = now = monotonic()
        clock = self.get_clock()
        self._arrivals[number].came(clock.now().nanoseconds * 1e-9 if clock.ros_time_is_active else now)
        if self._lockstep:
            self._answer()
        elif all(self._channels):
            self._take()
            self._catch_up()
            self._publish()

    def _take(self) -> None:
        """One sample of both channels."""
        flexor, extensor = self._channels
        self._emg.update(flexor.popleft(), extensor.popleft())
        self._taken += 1
        if self._emg.switches > self._switches:
            self._switches = self._emg.switches
            self.get_logger().info(f"co-contraction: switch event {self._switches}")

    def _catch_up(self) -> None:
        """Drop samples that have waited for the other channel all through a second: they came before it."""
        self._waiting = [min(least, len(c)) for least, c in zip(self._waiting, self._channels, strict=True)]
        if self._taken % self._p.rate:
            return
        for least, channel in zip(self._waiting, self._channels, strict=True):
            for _ in range(least):
                channel.popleft()
            self._health.count("dropped_samples", least)
        self._waiting = [_LONGEST_QUEUE, _LONGEST_QUEUE]

    def _publish(self) -> None:
        self._reference.publish(convert.float64_bytes(self._emg.reference))
        self._health.cycles += 1

    # -- lock-step ---------------------------------------------------------------------------------------------------
    def _on_tick_state(self, data: bytes) -> None:
        try:
            stamp_ns = convert.MOTOR_STATE.decode(data).stamp_ns
        except HannesError as error:
            self._health.count("rejected_states")
            self.get_logger().error(f"motor/state is rejected: {error}", throttle_duration_sec=5.0)
            return
        if self._stamp < 0 < stamp_ns:  # a newcomer: the samples before this tick went by
            self._taken = samples_until(stamp_ns, self._p.rate)
        elif stamp_ns < self._stamp:  # the simulator began again
            self._emg.reset()
            self._taken = 0
            self._ticks.clear()
        self._stamp = stamp_ns
        self._ticks.append(stamp_ns)
        self._answer()

    def _answer(self) -> None:
        """One reference for each tick whose samples are all here."""
        while self._ticks and self._peers.complete:
            needed = samples_until(self._ticks[0], self._p.rate)
            while self._taken < needed and all(self._channels):
                self._take()
            if self._taken < needed:
                return
            if self._probe.holds():
                return
            self._ticks.popleft()
            self._publish()

    def _on_surplus(self, name: str) -> None:
        """Samples of another source end the node; those of one source that began again went by and are dropped."""
        if self._sources.count(name) > 1:
            self.fail(self._sources.surplus(name))
            return
        dropped = sum(map(len, self._channels))
        self._health.count("dropped_samples", dropped)
        for channel in self._channels:
            channel.clear()
        self.get_logger().warning(
            f"{topics.signal(name).topic} is ahead of the ticks: {dropped} samples are dropped",
            throttle_duration_sec=5.0,
        )

    def _check(self) -> None:
        if self._probe.over():
            # The samples of the next tick come after its reading, which comes after the answer to this one.
            left_over = [name for name, channel in zip(_CHANNELS, self._channels, strict=True) if channel]
            if left_over:
                self._on_surplus(left_over[0])
            if not self.done:
                self._answer()
        if not self._peers.complete and not self._peers.missing():
            self._answer()

    def _rates(self, both: bool) -> str:
        """Rates of both channels; in real time, where `both` come, one that is not the parameter's is a fault.

        At two looks in a row: what waited while the machine was busy comes faster once.
        """
        rates = [arrivals.rate() for arrivals in self._arrivals]
        known, wanted = [rate for rate in rates if rate is not None], self._p.rate
        before, self._rate_off = self._rate_off, any(abs(r - wanted) > _RATE_OFF * wanted for r in known)
        if self._lockstep or not both or not self._rate_off:
            self._health.faults.good("rate")
        elif before:
            # A pair is taken when both are there: the slower channel tells how often.
            self._health.faults.bad(
                "rate",
                WARN,
                f"EMG comes at {' and '.join(f'{r:.0f}' for r in known)} Hz, and a sample counts for 1/{wanted} s: the "
                f"reference moves at {min(known) / wanted:.2g} times the speed. Start emg_reference with the rate of "
                "your EMG (-p rate:=..., 100 Hz or more)",
            )
        return ", ".join("" if rate is None else f"{rate:.1f}" for rate in rates)

    def _status(self) -> tuple[bytes, str, dict[str, object]]:
        values: dict[str, object] = {
            "reference_rad": f"{self._emg.reference:.6g}",
            "switch_events": self._switches,
            "samples": self._taken,
        }
        absent = [topic for topic in _TOPICS if topic not in self._heard]
        silent = "" if absent else silence({t: self._heard[t] for t in _TOPICS})
        values["emg_rates_hz"] = self._rates(not (absent or silent))
        if several := self._sources.several():
            return ERROR, several, values
        if self._lockstep and (missing := self._peers.missing()):
            return WARN, f"waiting for {', '.join(missing)}", values
        if absent:
            return WARN, f"waiting for {' and '.join(absent)}", values
        # In lock-step there is nothing to hear while no tick waits for it.
        if silent and (self._ticks or not self._lockstep):
            return WARN, f"{silent}: the reference stands", values
        if self._ticks:
            return OK, "waiting for EMG samples", values
        return OK, "running", values


def main() -> None:
    """Run the node."""
    sys.exit(run_node("hannes_control.emg_reference_node:EmgReferenceNode"))


if __name__ == "__main__":
    main()
