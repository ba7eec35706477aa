"""The node `stiffness_classifier`: motor current, reference and encoder in; label, class, probability, stiffness out.

Time is the stamp of motor/state, so simulated, recorded and real time all work, at any rate of the inputs. In real time
each state meets the newest current and reference; in lock-step the messages of one tick meet.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from time import monotonic

from hannes_description.errors import HannesError
from hannes_ros.convert import MOTOR_STATE, JointSample, float64_bytes, float64_value
from hannes_ros.diagnostics import ERROR, OK, WARN, Diagnostics, Health, silence
from hannes_ros.lockstep import TickJoin
from hannes_ros.node import CLOCK_HELP, CLOCKS, DEFAULT_NAMESPACE, HannesNode
from hannes_ros.node_parameters import declare, parameter
from hannes_ros.run import run_node
from hannes_ros.sources import Sources
from hannes_ros.topics import publisher, signal, subscription
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray, String

from .classifier import NOT_SURE, StiffnessClassifier, class_label
from .features import FeatureStream, Sample, believable

_STATE, _CURRENT, _REFERENCE = range(3)
_PATIENCE_S = 2.0
"""s without an answer to states that come, from which on that is said."""
_INPUTS = ("encoder_position", "motor_current", "reference_position")
_NAMES = tuple(signal(name).topic for name in _INPUTS)
_LONGEST_QUEUE = 4000
"""Messages without a whole tick after which lock-step is joined anew; most currents kept between two states.

More than three topics can hold in their queues: after a slow start these come topic by topic.
"""


@dataclass(frozen=True)
class StiffnessParameters:
    """Parameters of the node."""

    classifier: str = parameter(
        "", "Trained classifier (.onnx, its .json beside it), or baseline; empty: the one installed"
    )
    sure: float = parameter(
        -1.0,
        'Least probability of an answer; below it "not sure"; negative: as the classifier was trained',
        lower=-1.0,
        upper=1.0,
    )
    rate: float = parameter(30.0, "Answers per second of message time", lower=0.1, upper=1000.0, unit="Hz")
    timeout: float = parameter(
        0.25, "Age of current or reference from which there is no answer", lower=0.01, upper=10.0, unit="s"
    )
    clock: str = parameter("realtime", CLOCK_HELP, choices=CLOCKS)


class StiffnessNode(HannesNode, Node):
    """Classifies the grasp from the motor's signals."""

    node_name = "stiffness_classifier"
    parameters = StiffnessParameters

    def __init__(self, cli_args: Sequence[str] | None = None) -> None:
        super().__init__(self.node_name, namespace=DEFAULT_NAMESPACE, cli_args=cli_args)
        self._settings = declare(self, StiffnessParameters)
        self._classifier = StiffnessClassifier.load(self._settings.classifier)
        self._sure = self._settings.sure if self._settings.sure >= 0.0 else self._classifier.least
        self._stream = FeatureStream(self._classifier.spec, self._settings.rate)
        self._health = Health(
            "not_finite", "not_believable", "unknown_joint", "stale_input", "lost_ticks", "not_sure"
        )
        self._answered_at = monotonic()
        self._counted: dict[str, int] = {}
        self._latest: dict[int, tuple[float, float]] = {}
        self._currents: list[float] = []
        self._join = TickJoin(3, _LONGEST_QUEUE)
        # From the first message on, since nothing waits for this node: it may have missed the first ticks, but then of
        # all topics alike.
        self._join.synchronise()
        self._queued = 0
        self._stamp_ns: int | None = None
        self._period_ns = 0
        self._time = -math.inf
        self._label = ""
        self._probability = publisher(self, "stiffness_probability")
        self._class = publisher(self, "stiffness_class")
        self._text = publisher(self, "stiffness_label")
        self._estimate = publisher(self, "stiffness_estimate")
        # The first answer compiles nothing and loads nothing any more.
        self._answer(Sample(0.0, (0.0,) * len(self._classifier.spec.names), False))
        FeatureStream(self._classifier.spec).push(0.0, 0.0, 0.0, 0.0)
        subscription(self, "motor_current", lambda data: self._number(_CURRENT, data))
        subscription(self, "reference_position", lambda data: self._number(_REFERENCE, data))
        subscription(self, "encoder_position", self._state)
        self._sources = Sources(self, *_INPUTS)
        self._diagnostics = Diagnostics(self, self._health, self._report)

    def _number(self, slot: int, data: bytes) -> None:
        value = float64_value(data)
        if self._settings.clock == "lockstep":
            self._tick(slot, value)
        elif self._is_finite(slot, value):
            self._latest[slot] = (value, self._time)
            if slot == _CURRENT and len(self._currents) < _LONGEST_QUEUE:
                self._currents.append(value)

    def _is_finite(self, slot: int, value: float) -> bool:
        """Whether an input is finite; if not it is counted and said."""
        if math.isfinite(value):
            self._health.faults.good(f"{_NAMES[slot]}, finite")
            return True
        self._health.count("not_finite")
        self._health.faults.bad(
            f"{_NAMES[slot]}, finite", ERROR, f"{_NAMES[slot]} is not finite ({value}): no answer"
        )
        return False

    def _state(self, data: bytes) -> None:
        self._health.last_input = monotonic()
        try:
            sample = MOTOR_STATE.decode(data)
        except HannesError as error:
            self._health.count("unknown_joint")
            self._health.faults.bad(_NAMES[_STATE], ERROR, f"motor/state is rejected: {error}")
            return
        self._health.faults.good(_NAMES[_STATE])
        if self._settings.clock == "lockstep":
            self._follow(sample.stamp_ns)
            self._tick(_STATE, sample)
            return
        self._time = sample.stamp_ns * 1e-9
        if len(self._latest) < 2:
            return
        (current, heard), (reference, asked) = self._latest[_CURRENT], self._latest[_REFERENCE]
        # A value that came before the first state has no time; it counts from that state on.
        heard, asked = (self._time if at == -math.inf else at for at in (heard, asked))
        self._latest = {_CURRENT: (current, heard), _REFERENCE: (reference, asked)}
        if self._currents:
            # A current that comes oftener than the state is averaged between two states, as the sensor would.
            rectified = self._classifier.spec.current == "rectified"
            current = sum(map(abs, self._currents) if rectified else self._currents) / len(self._currents)
            self._latest[_CURRENT] = (current, heard)
            self._currents.clear()
        if abs(self._time - min(heard, asked)) > self._settings.timeout:
            self._health.count("stale_input")
            return
        self._classify(sample, current, reference)

    def _follow(self, stamp_ns: int) -> None:
        """Join anew where a tick was lost: after that the order of messages no longer tells what belongs together."""
        step = 0 if self._stamp_ns is None else stamp_ns - self._stamp_ns
        self._stamp_ns = stamp_ns
        if step > 0 and (self._period_ns == 0 or step < self._period_ns):
            self._period_ns = step
        elif step < 0 or step > self._period_ns > 0:
            self._rejoin()

    def _rejoin(self) -> None:
        self._health.count("lost_ticks")
        self._join.reset()
        self._join.synchronise()
        self._queued = 0

    def _tick(self, slot: int, item: JointSample | float) -> None:
        self._join.put(slot, item)
        self._queued += 1
        taken = self._join.take()
        if taken is not None:
            self._queued = 0
            self._classify(*taken)
        if (ahead := self._join.surplus) is not None and self._sources.count(_INPUTS[ahead]) > 1:
            self.fail(self._sources.surplus(_INPUTS[ahead]))
        elif ahead is not None or self._queued > _LONGEST_QUEUE:
            self._rejoin()

    def _classify(self, state: JointSample, current: float, reference: float) -> None:
        encoder = state.position[0]
        finite = [self._is_finite(slot, value) for slot, value in enumerate((encoder, current, reference))]
        if not all(finite):
            return
        if not believable(current, reference, encoder):
            self._health.count("not_believable")
            self._health.faults.bad(
                "range",
                ERROR,
                f"no hand has {current:g} A, a reference of {reference:g} rad and a position of {encoder:g} rad: no "
                "answer; are they in A and rad?",
            )
            return
        self._health.faults.good("range")
        sample = self._stream.push(state.stamp_ns * 1e-9, current, reference, encoder)
        if sample is None:
            return
        best, probability, stiffness = self._answer(sample)
        self._label = class_label(best)
        if best == NOT_SURE:
            self._health.count("not_sure")
        self._probability.publish(Float64MultiArray(data=probability))
        self._class.publish(float64_bytes(float(best)))
        self._text.publish(String(data=self._label))
        if best != 0 and math.isfinite(stiffness[0]):
            self._estimate.publish(Float64MultiArray(data=stiffness))
        self._health.cycles += 1
        self._answered_at = monotonic()

    def _answer(self, sample: Sample) -> tuple[int, list[float], list[float]]:
        """Class, probabilities and stiffness of one sample."""
        answers = self._classifier.answer([sample.values], [sample.void])
        return (
            int(answers.sure(self._sure)[0]),
            answers.probabilities[0].tolist(),
            answers.stiffness[0].tolist(),
        )

    def _report(self) -> tuple[bytes, str, Mapping[str, object]]:
        values = {
            "label": self._label,
            "out_of_order": self._stream.rejected,
            "restarts": self._stream.restarts,
            "classifier_sha256": self._classifier.manifest["onnx"]["sha256"][:12],
        }
        if several := self._sources.several():
            return ERROR, several, values
        if self._health.last_input is None:
            return WARN, "waiting for motor/state", values
        if self._settings.clock == "lockstep":
            silent = [
                name for slot, name in enumerate(_NAMES) if slot in self._join.missing() and self._queued > 10
            ]
        else:
            silent = [
                _NAMES[slot]
                for slot in (_CURRENT, _REFERENCE)
                if slot not in self._latest or self._time - self._latest[slot][1] > self._settings.timeout
            ]
        before, self._counted = self._counted, {**self._health.counts, "out_of_order": self._stream.rejected}
        if silent:
            return WARN, f"no {' and no '.join(silent)}", values
        waited = monotonic() - self._answered_at > max(_PATIENCE_S, 3.0 / self._settings.rate)
        if waited and silence({_NAMES[_STATE]: self._health.last_input}) is None:
            new = {name: count - before.get(name, 0) for name, count in self._counted.items()}
            why = ", ".join(f"{name} {count}" for name, count in new.items() if count and name != "not_sure")
            return WARN, f"no answer to motor/state{f' ({why})' if why else ''}", values
        return OK, "classifying", values


def main() -> None:
    """Entry point of the executable `stiffness_classifier`."""
    sys.exit(run_node("hannes_stiffness.stiffness_node:StiffnessNode"))
