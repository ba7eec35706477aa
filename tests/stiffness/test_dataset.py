"""Data sets by rollout: the same from the same seed, safe on disk; what they teach holds on unseen closures."""

import json

import numpy as np
import pytest
from hannes_bags.recording import Channel, Recording
from hannes_bags.writing import write_recording
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_sim.effect import strength_of
from hannes_sim.objects import RIGID_DYNAMOMETER, SOFT_BALL, GraspObject
from hannes_stiffness.classifier import StiffnessClassifier
from hannes_stiffness.cli import app
from hannes_stiffness.dataset import (
    THESIS_OBJECTS,
    VARIETIES,
    Dataset,
    Scene,
    bench_scenes,
    draw_scenes,
    hand_of,
    kind_of,
    label,
    make_dataset,
    merge,
)
from hannes_stiffness.evaluation import answer, kind_name, scores_of
from hannes_stiffness.features import WINDOW, FeatureSpec, extract
from hannes_stiffness.models import TreeSettings
from hannes_stiffness.training import scene_of, train
from typer.testing import CliRunner

MODEL = Model.load("nominal").with_plant("reduced")
SMALL = TreeSettings(trees=8, leaves=64)


@pytest.fixture(scope="module")
def small():
    return make_dataset(draw_scenes(90, 1), MODEL, seed=1)


@pytest.fixture(scope="module")
def trained(small, tmp_path_factory):
    path = tmp_path_factory.mktemp("trained") / "small.onnx"
    held_out = {"held_out": make_dataset(draw_scenes(45, 7), MODEL, seed=7)}
    return train(small, path, seed=1, settings=SMALL, held_out=held_out), held_out["held_out"]


def test_the_same_seed_gives_the_same_data_on_any_number_of_processes(small):
    again = make_dataset(draw_scenes(6, 1), MODEL, seed=1, jobs=2)
    for a, b in zip(again.closures, small.closures, strict=False):
        assert a.scene == b.scene
        for name in ("time", "current", "reference", "encoder", "force"):
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
    other = make_dataset(draw_scenes(3, 2), MODEL, seed=2)
    assert not np.array_equal(other.closures[1].current, small.closures[1].current)


def test_the_data_look_as_the_thesis_logs_them(small):
    kinds = {c.scene.kind for c in small.closures}
    assert kinds == {"void", "rigid", "soft"}
    for closure in small.closures:
        np.testing.assert_allclose(np.diff(closure.time), 1 / 30, atol=1e-3)
        assert (closure.current >= 0.0).all()
        assert np.isfinite(closure.encoder).all()
    assert all(c.force.max() == 0.0 for c in small.closures if c.scene.kind == "void")
    grasps = [c.force.max() for c in small.closures if c.scene.kind != "void"]
    assert np.mean(np.array(grasps) > 1.0) > 0.9


def test_labels_follow_the_void_current_and_the_start_of_the_closure(small):
    closure = next(c for c in small.closures if c.scene.kind == "rigid")
    features = extract(closure.time, closure.current, closure.reference, closure.encoder)
    labels = label(features, closure)
    assert (labels[features.values[:, 0] < 0.3] == 0).all()
    by_rule = label(features, closure, contact=False)
    np.testing.assert_array_equal(by_rule > 0, ~features.void)
    assert (by_rule >= labels).all()
    force = closure.force[np.searchsorted(closure.time, features.time)]
    np.testing.assert_array_equal(labels > 0, ~features.void & (force > 0.5))
    assert labels.max() == 1
    early = features.time < 0.2
    assert (features.values[early, 0] > 0.3).any()
    assert (labels[early] == 0).all()


def same(a, b):
    assert a.scene == b.scene
    for name in ("time", "current", "reference", "encoder", "force", "touched"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_a_bag_set_is_resumed_and_reads_back_the_same(tmp_path):
    scenes = draw_scenes(30, 4, hands=5, variety="wide", objects=6)
    whole = make_dataset(scenes, MODEL, seed=4)
    folder = tmp_path / "set"
    make_dataset(scenes, MODEL, seed=4, folder=folder)
    again = tmp_path / "again"
    make_dataset(scenes, MODEL, seed=4, folder=again, jobs=2)
    first, second = (p / "part_00000" / "part_00000.part_0.mcap" for p in (folder, again))
    assert first.read_bytes() == second.read_bytes()
    # An interruption: a part is missing, another is half written, and the manifest is not finished.
    stamp = first.stat().st_mtime_ns
    (folder / "part_00001").rename(folder / "part_00001.part")
    manifest = json.loads((folder / "manifest.json").read_text())
    parts = manifest.pop("parts")
    (folder / "manifest.json").write_text(json.dumps(manifest))
    with pytest.raises(HannesError, match="not finished"):
        Dataset.load(folder)
    resumed = make_dataset(scenes, MODEL, seed=4, folder=folder)
    assert first.stat().st_mtime_ns == stamp
    assert resumed.manifest["parts"] == parts
    for a, b, c in zip(whole.closures, resumed.closures, Dataset.load(folder).closures, strict=True):
        same(a, b)
        same(a, c)
    with pytest.raises(HannesError, match="seed"):
        make_dataset(scenes, MODEL, seed=5, folder=folder)


@pytest.mark.parametrize("content", [None, b"", b"{", b"[]", b'{"schema": "other"}', b"[" * 100_000])
def test_a_broken_data_set_is_refused(content, tmp_path):
    if content is not None:
        (tmp_path / "manifest.json").write_bytes(content)
    with pytest.raises(HannesError, match="not a stiffness data set"):
        Dataset.load(tmp_path)


def test_sets_train_together_and_their_objects_and_hands_stay_apart(small):
    other = make_dataset(draw_scenes(9, 2, hands=3), MODEL, seed=2)
    both = merge([small, other])
    assert merge([small]) is small
    with pytest.raises(HannesError, match="more than once"):
        merge([small, small])
    assert len(both.closures) == len(small.closures) + 9
    a, b = (d.training_data(FeatureSpec()) for d in (small, both))
    np.testing.assert_array_equal(b.values[: len(a.values)], a.values)
    assert not set(b.hands[: len(a.values)]) & set(b.hands[len(a.values) :])
    assert len(both.manifest["sets"]) == 2
    with pytest.raises(HannesError, match="no data set"):
        merge([])


def test_wide_scenes_range_over_what_they_should():
    wide = VARIETIES["wide"]
    scenes = draw_scenes(600, 1, hands=50, variety="wide", objects=200)
    grasps = [s.grasp for s in scenes if s.grasp is not None]
    assert 0.1 < 1 - len(grasps) / 600 < 0.2
    assert {g.shape for g in grasps} == {"capsule", "sphere", "box", "prism"}
    stiffness = np.log10([g.stiffness for g in grasps])
    assert stiffness.min() < 2.1
    assert stiffness.max() > 4.9
    assert abs(np.median(stiffness) - 3.5) < 0.3
    assert all(wide.sizes[0] <= g.size <= wide.sizes[1] for g in grasps)
    assert {s.profile for s in scenes} == {"half_sine", "ramp_hold", "reversals"}
    assert min(s.hand for s in scenes) == 1
    assert len({s.object for s in scenes}) <= 201
    again = draw_scenes(10, 1, hands=50, variety="wide", objects=200)
    assert again == scenes[:10]


def test_the_thesis_test_has_four_rigid_and_six_soft_objects():
    kinds = [kind_of(g) for g in THESIS_OBJECTS.values()]
    assert (kinds.count("rigid"), kinds.count("soft")) == (4, 6)
    scenes = bench_scenes(13, 39, model="nominal")
    assert len(scenes) == 390
    assert {s.hand for s in scenes} == set(range(1, 14))


def test_varied_hands_have_hidden_effects():
    hands = [hand_of(MODEL, k, 1, varied=True) for k in range(1, 30)]
    assert {len(h.effects) for h in hands} == {0, 1, 2, 3}
    assert hand_of(MODEL, 5, 1, varied=True).sha256 == hands[4].sha256
    assert hand_of(MODEL, 0, 1, varied=True) is MODEL


def test_a_hidden_effect_adds_to_what_the_model_has_of_it():
    own = MODEL.with_effect(strength_of("load_dependent_friction", 5.0))

    def friction(model, hand):
        found = [
            e for e in hand_of(model, hand, 1, varied=True).effects if e.name == "load_dependent_friction"
        ]
        return found[0].values["coefficient"] if found else 0.0

    base = own.effects[0].values["coefficient"]
    drawn = [(friction(MODEL, k), friction(own, k)) for k in range(1, 80)]
    assert any(hidden for hidden, _ in drawn)
    for hidden, both in drawn:
        np.testing.assert_allclose(both, min(1.0, base + hidden))


def test_hands_of_the_population_differ_within_their_bounds():
    assert hand_of(MODEL, 0, 1) is MODEL
    a, b = hand_of(MODEL, 1, 1), hand_of(MODEL, 2, 1)
    assert len({MODEL.sha256, a.sha256, b.sha256}) == 3
    assert hand_of(MODEL, 1, 1).sha256 == a.sha256
    for name in a.parameters:
        p = MODEL.parameters[name]
        assert p.lower <= a.parameters.value(name) <= p.upper


def test_kinds_by_stiffness():
    assert kind_of(None) == "void"
    assert kind_of(SOFT_BALL) == "soft"
    assert kind_of(RIGID_DYNAMOMETER) == "rigid"


@pytest.mark.parametrize(
    "call",
    [
        lambda: Scene("a", "hard", None),
        lambda: Scene("a", "void", GraspObject()),
        lambda: Scene("a", "soft", None),
        lambda: Scene("a", "soft", GraspObject(), profile="square"),
        lambda: draw_scenes(0, 1),
        lambda: draw_scenes(3, 1, variety="broad"),
        lambda: make_dataset(draw_scenes(3, 1), MODEL, MODEL, seed=1),
        lambda: make_dataset(draw_scenes(3, 1, models=["other"]), MODEL, seed=1),
        lambda: make_dataset(draw_scenes(3, 1), MODEL, seed=1, jobs=0),
    ],
)
def test_what_cannot_be_is_refused(call):
    with pytest.raises(HannesError):
        call()


def test_unseen_objects_are_told_apart(trained):
    path, held_out = trained
    classifier = StiffnessClassifier.load(path)
    result = scores_of(answer(classifier, held_out.closures), kind_name)["hop_50ms"]["pooled"]
    # Chance: with two thirds of all graspings rightly called void, the mean F1 of a guess is below 0.5.
    assert result["f1"] > 0.8
    assert min(c["f1"] for c in result["classes"].values()) > 0.7
    scores = classifier.manifest["scores"]
    assert scores["held_out"]["hop_50ms"] == result
    assert scores["cross_validation"]["thesis"]["closures"]["hop_50ms"]["f1"] > 0.8


def test_training_twice_gives_the_same_predictions(small, trained, tmp_path):
    again = StiffnessClassifier.load(train(small, tmp_path / "again.onnx", seed=1, settings=SMALL))
    x = small.training_data(FeatureSpec()).values
    never = np.zeros(len(x), bool)
    np.testing.assert_array_equal(
        again.probabilities(x, never), StiffnessClassifier.load(trained[0]).probabilities(x, never)
    )


def test_the_shipped_classifier_knows_the_thesis_objects():
    classifier = StiffnessClassifier.load("baseline")
    scenes = (
        Scene("none", "void", None),
        Scene("soft", "soft", SOFT_BALL),
        Scene("rigid", "rigid", RIGID_DYNAMOMETER),
    )
    result = scores_of(answer(classifier, make_dataset(scenes, MODEL, seed=5).closures))
    assert result["hop_50ms"]["pooled"]["f1"] > 0.9


# The bag of a hand that logs neither velocity nor effort is read with a warning.
pytestmark = pytest.mark.filterwarnings("ignore::hannes_bags.reading.RecordingWarning")


@pytest.fixture
def bag(small, tmp_path):
    closure = max((c for c in small.closures if c.scene.kind == "soft"), key=lambda c: c.force.max())
    units = {"motor_current": "A", "reference_position": "rad", "encoder_position": "rad"}
    values = dict(zip(units, (closure.current, closure.reference, closure.encoder), strict=True))
    channels = {n: Channel(closure.time, values[n], unit, n) for n, unit in units.items()}
    return write_recording(Recording(channels, {"object": "soft"}), tmp_path / "soft_bag")


@pytest.fixture(scope="module")
def windowed(tmp_path_factory):
    """A classifier on windows, trained on a small varied set, and closures that it did not see."""
    folder = tmp_path_factory.mktemp("windowed")
    data = make_dataset(draw_scenes(240, 3, hands=40, variety="wide"), MODEL, seed=3)
    path = train(data, folder / "w.onnx", seed=3, method="logistic", settings=TreeSettings(folds=3))
    return path, make_dataset(
        draw_scenes(60, 8, hands=20, variety="wide"), MODEL, seed=8, folder=folder / "set"
    )


def test_one_hand_is_not_held_out(tmp_path):
    data = make_dataset(draw_scenes(40, 4), MODEL, seed=4)
    path = train(data, tmp_path / "one.onnx", seed=4, method="logistic", settings=TreeSettings(folds=2))
    scores = StiffnessClassifier.load(path).manifest["scores"]["cross_validation"]["logistic"]
    assert "objects" in scores
    assert "hands" not in scores


def test_a_classifier_on_windows_beats_chance_and_says_when_it_is_not_sure(windowed):
    path, other = windowed
    classifier = StiffnessClassifier.load(path)
    answered = answer(classifier, other.closures)
    result = scores_of(answered, kind_name)
    assert result["hop_50ms"]["pooled"]["f1"] > 0.7
    late = result["latency"]["pooled"]
    # The first touch comes first, the grip that the motor feels after it.
    assert late["from_contact_median_s"] > late["from_grip_median_s"] >= 0.0
    refused = result["not_sure"]
    assert 0.0 < refused["part"] < 0.9
    assert refused["right_when_sure"] > refused["right_if_forced"]
    assert 0.75 < result["stiffness"]["samples"]["covered"] < 1.0
    for a in answered:
        low, high = a.answers.stiffness[:, 1], a.answers.stiffness[:, 2]
        np.testing.assert_array_equal(np.isnan(low), a.void)
        assert (low[~a.void] <= high[~a.void]).all()


def test_evaluate_a_bag_set_with_pictures(windowed, tmp_path):
    path, other = windowed
    result = run("evaluate", path.parent / "set", "--classifier", path, "--pictures", tmp_path, "--json")
    assert result.exit_code == 0, result.output
    scores = json.loads(result.stdout)
    assert scores["closures"] == len(other.closures)
    assert scores["stiffness"]["grasps"]["count"] > 10
    for name in ("closures.png", "scores.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")


def test_features_of_the_shipped_classifier_are_those_of_the_code():
    classifier = StiffnessClassifier.load()
    assert classifier.spec.version == WINDOW
    scenes = [Scene("soft", "soft", SOFT_BALL), Scene("rigid", "rigid", RIGID_DYNAMOMETER)]
    answered = answer(classifier, make_dataset(scenes, MODEL, seed=5).closures)
    assert [a.grasp for a in answered] == [2, 1]
    assert all(a.latency(a.closure.touched) < 0.5 for a in answered)


def run(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_evaluate_a_bag(bag, trained):
    result = run("evaluate", bag, "--classifier", trained[0], "--json")
    assert result.exit_code == 0, result.output
    scores = json.loads(result.stdout)
    assert scores["hop_50ms"]["objects"]["soft"]["classes"]["soft"]["support"] > 5
    assert scores["overlap_50ms"]["hop_s"] == 0.15
    table = run("evaluate", bag, "--classifier", trained[0])
    assert "pooled" in table.stdout


def test_evaluate_needs_the_truth_and_the_signals(bag, trained):
    with pytest.raises(HannesError, match="--kind"):
        scene_of(Recording(dict(_soft(bag).channels), {}, "x"))
    assert (
        scene_of(Recording(dict(_soft(bag).channels), {"object": RIGID_DYNAMOMETER.to_dict()}, "x")).kind
        == "rigid"
    )
    assert scene_of(_soft(bag), "void").kind == "void"
    with pytest.raises(HannesError, match="void, rigid, soft"):
        scene_of(_soft(bag), "firm")
    result = run("evaluate", bag.parent / "none")
    assert isinstance(result.exception, HannesError)


def _soft(bag):
    from hannes_bags.reading import read_bag

    return read_bag(bag)


def test_dataset_and_train_from_the_command_line(tmp_path):
    few = ("--variety", "narrow", "--model", "nominal", "--hands", 1)
    result = run("dataset", "--out", tmp_path / "d", "--closures", 30, "--seed", 3, "--json", *few)
    assert result.exit_code == 0, result.output
    assert sum(json.loads(result.stdout)["kinds"].values()) == 30
    given = ("--data", tmp_path / "d", "--method", "thesis", "--trees", 4, "--held-out", 60)
    result = run("train", "--out", tmp_path / "c.onnx", "--json", *given, *few)
    assert result.exit_code == 0, result.output
    manifest = json.loads(result.stdout)
    assert set(manifest["scores"]) == {"cross_validation", "held_out, nominal"}
    assert manifest["training"]["models"]["nominal"]["sha256"] == Model.load().sha256
    assert run("train", "--out", tmp_path / "c.onnx", *given, *few).exit_code == 0
