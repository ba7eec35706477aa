"""The node alone, driven over topics: it answers as the array code does, rejects what it should, and ends quietly."""

import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from hannes_control.double_pid import DoublePID
from hannes_control.reference import half_sine
from hannes_description.model import Model
from hannes_ros import convert, topics
from hannes_ros.convert import JointSample
from hannes_sim.factory import make_plant
from hannes_sim.objects import RIGID_DYNAMOMETER
from hannes_sim.rollout import rollout
from hannes_stiffness.classifier import NOT_SURE, StiffnessClassifier, class_label
from hannes_stiffness.features import extract
from patience import PATIENCE
from rclpy.duration import Duration

pytestmark = pytest.mark.ros

_START = "from hannes_stiffness.stiffness_node import main; main()"


@pytest.fixture(scope="module")
def closure():
    """A closure on the rigid object at 100 Hz: time s, current A, reference rad, encoder rad."""
    model = Model.load("nominal").with_plant("reduced")
    run = rollout(make_plant(model, RIGID_DYNAMOMETER), DoublePID.of_model(model.parameters), half_sine())
    return tuple(a[::10] for a in (run.time, run.motor_current, run.reference_position, run.encoder_position))


class Bench:
    """A node on the other side of the topics: publishes the hand's signals, keeps the answers."""

    def __init__(self, context, *arguments):
        import rclpy
        from rclpy.executors import SingleThreadedExecutor

        self.node = rclpy.create_node("bench", context=context, namespace="hannes")
        self.executor = SingleThreadedExecutor(context=context)
        self.executor.add_node(self.node)
        self.out = {
            n: topics.publisher(self.node, n)
            for n in ("motor_current", "reference_position", "encoder_position")
        }
        self.classes, self.labels, self.probabilities, self.estimates, self.health = [], [], [], [], {}
        node = self.node
        node.create_subscription(
            topics.message_type("stiffness_class"),
            "stiffness/class",
            lambda m: self.classes.append(int(m.data)),
            topics.qos("stiffness_class"),
        )
        node.create_subscription(
            topics.message_type("stiffness_label"),
            "stiffness/label",
            lambda m: self.labels.append(m.data),
            topics.qos("stiffness_label"),
        )
        node.create_subscription(
            topics.message_type("stiffness_probability"),
            "stiffness/probability",
            lambda m: self.probabilities.append(list(m.data)),
            topics.qos("stiffness_probability"),
        )
        node.create_subscription(
            topics.message_type("stiffness_estimate"),
            "stiffness/estimate",
            lambda m: self.estimates.append(list(m.data)),
            topics.qos("stiffness_estimate"),
        )
        from diagnostic_msgs.msg import DiagnosticArray

        node.create_subscription(
            DiagnosticArray, topics.DIAGNOSTICS_TOPIC, self._healthy, topics.DIAGNOSTICS_QOS
        )
        command = [sys.executable, "-c", _START, "--ros-args", *(w for a in arguments for w in ("-p", a))]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        # The first report says that the node spins: what comes before that, it takes topic by topic.
        self.wait(lambda: self.health and all(p.get_subscription_count() for p in self.out.values()))

    def _healthy(self, message):
        for status in message.status:
            self.health = {v.key: v.value for v in status.values} | {
                "message": status.message,
                "level": status.level[0],
            }

    def wait(self, condition):
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, (
                f"waited in vain; health {self.health}, {len(self.classes)} answers"
            )
            assert self.process.poll() is None, self.process.stdout.read()
            self.executor.spin_once(0.02)

    def publish(self, time_s, current, reference, encoder):
        stamp = round(time_s * 1e9)
        self.out["motor_current"].publish(convert.float64_bytes(current))
        self.out["reference_position"].publish(convert.float64_bytes(reference))
        self.out["encoder_position"].publish(convert.MOTOR_STATE.encode(stamp, (encoder,), (0.0,), (0.0,)))

    def end(self, number):
        self.process.send_signal(number)
        output = self.process.communicate(timeout=PATIENCE)[0]
        return self.process.returncode, output

    def close(self):
        if self.process.poll() is None:
            self.process.kill()
        self.process.communicate()
        self.executor.shutdown()
        self.node.destroy_node()


@pytest.fixture
def bench(ros_context):
    made = []

    def make(*arguments):
        made.append(Bench(ros_context, *arguments))
        return made[-1]

    yield make
    for each in made:
        each.close()


def expected(arrays, name="", least=None):
    """Answered classes, not sure among them, and all the answers."""
    classifier = StiffnessClassifier.load(name)
    features = extract(*arrays, classifier.spec)
    answers = classifier.answer(features.values, features.void)
    return answers.sure(classifier.least if least is None else least), answers


def test_in_lockstep_it_answers_as_the_array_code(bench, closure):
    it = bench("clock:=lockstep")
    classes, answers = expected(closure)
    assert (classes > 0).sum() > 20
    stiffness = answers.stiffness[classes != 0]
    for row in zip(*closure, strict=True):
        it.publish(*map(float, row))
    it.wait(
        lambda: (
            len(it.classes) >= len(classes)
            and len(it.labels) >= len(classes)
            and len(it.probabilities) >= len(classes)
            and len(it.estimates) >= len(stiffness)
        )
    )
    np.testing.assert_array_equal(it.classes, classes)
    np.testing.assert_allclose(it.probabilities, answers.probabilities, atol=1e-7)
    np.testing.assert_allclose(it.estimates, stiffness, rtol=1e-6)
    assert it.labels == [class_label(k) for k in classes]
    code, output = it.end(signal.SIGINT)
    assert code == 0, output
    assert "Traceback" not in output


def test_below_the_least_probability_it_is_not_sure_and_the_thesis_method_gives_no_stiffness(bench, closure):
    it = bench("clock:=lockstep", "classifier:=baseline", "sure:=0.999")
    classes, _ = expected(closure, "baseline", 0.999)
    assert (classes == NOT_SURE).any()
    for row in zip(*closure, strict=True):
        it.publish(*map(float, row))
    it.wait(lambda: len(it.classes) >= len(classes) and len(it.labels) >= len(classes))
    np.testing.assert_array_equal(it.classes, classes)
    assert "not sure" in it.labels
    assert it.estimates == []


def test_in_real_time_it_survives_bad_values_gaps_and_a_restart(bench, closure):
    it = bench("clock:=realtime", "rate:=30.0")
    grip = np.flatnonzero((closure[0] > 0.8) & (closure[0] < 1.2))
    rows = [tuple(float(a[k]) for a in closure) for k in grip]

    classes = expected(tuple(a[grip] for a in closure))[0]

    def play(start):
        before = len(it.classes)
        for t, *values in rows:
            it.publish(t + start, *values)
            # One message of each topic at a time, as a hand sends them.
            for _ in range(3):
                it.executor.spin_once(0.001)
        it.wait(lambda: len(it.classes) >= before + len(classes))
        # Topics may overtake each other by a message, so that an answer at the edge may differ.
        return np.mean(np.array(it.classes[before:]) == classes) > 0.7

    assert play(0.0)
    it.publish(2.0, float("nan"), 1.0, 1.0)
    it.publish(2.01, 1.0, float("inf"), 1.0)
    it.publish(2.02, 1.0, 1.0, float("nan"))
    from sensor_msgs.msg import JointState

    other = convert.joint_message(["elbow"], JointSample(2_030_000_000, (1.0,)))
    assert isinstance(other, JointState)
    it.out["encoder_position"].publish(other)
    assert play(60.0)
    assert play(0.0)
    it.wait(
        lambda: (
            it.health.get("unknown_joint") == "1"
            and int(it.health.get("not_finite", 0)) >= 2
            and int(it.health.get("restarts", 0)) >= 2
        )
    )
    it.wait(lambda: it.health["message"] == "classifying")
    assert it.health["classifier_sha256"] == StiffnessClassifier.load().manifest["onnx"]["sha256"][:12]
    code, output = it.end(signal.SIGTERM)
    assert code == 0, output
    assert "Traceback" not in output


def test_what_it_does_not_answer_is_said(bench, closure):
    it = bench("clock:=realtime")
    clock = iter(np.arange(1, 100_000) * 0.01)

    def said(words, current, encoder, stamped=True):
        def heard():
            it.publish(next(clock) if stamped else 0.0, current, 5.0, encoder)
            return words in it.health["message"]

        it.wait(heard)
        return it.health["level"]

    assert said("motor/current is not finite (nan): no answer", float("nan"), 1.0) == 2
    assert said("motor/state is not finite (nan)", 1.0, float("nan")) == 2
    assert said("no hand has 400 A", 400.0, 1.0) == 2
    assert said("classifying", 0.4, 1.0) == 0
    assert said("no answer to motor/state (", 0.4, 1.0, stamped=False) == 1
    other = convert.joint_message(["elbow"], JointSample(2_030_000_000, (1.0,)))

    def rejected():
        it.out["encoder_position"].publish(other)
        return "motor/state is rejected: the joints are ['elbow']" in it.health["message"]

    it.wait(rejected)


def test_a_second_source_is_an_error_and_ends_a_lockstep_that_waits_for_what_it_is_ahead_of(bench):
    it = bench("clock:=lockstep")
    second = topics.publisher(it.node, "reference_position")
    it.wait(lambda: it.health["message"] == "2 publishers of reference_position; end all but one")
    assert it.health["level"] == 2
    for _ in range(82):
        for _ in range(50):
            second.publish(convert.float64_bytes(1.0))
        # All at once is more than the topic holds.
        if it.process.poll() is None:
            second.wait_for_all_acked(Duration(seconds=1))
    output = it.process.communicate(timeout=PATIENCE)[0]
    assert it.process.returncode == 2
    last = output.splitlines()[-1]
    assert "reference_position has more messages than the ticks need, and 2 publishers." in last
    assert "Traceback" not in output


@pytest.mark.parametrize(
    "argument, words",
    [
        ("classifier:=/nowhere/x.onnx", "Cannot read"),
        ("rate:=0.0", "rate"),
        ("clock:=sundial", "realtime, lockstep"),
        ("colour:=red", "colour"),
    ],
)
def test_a_wrong_parameter_is_one_line_and_exit_code_2(ros_environment, argument, words):
    done = subprocess.run(
        [sys.executable, "-c", _START, "--ros-args", "-p", argument],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode == 2, done.stderr
    assert words in done.stderr
    assert "Traceback" not in done.stderr
