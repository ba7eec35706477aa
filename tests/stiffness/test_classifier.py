"""The trained classifier: on disk as in memory, the same from the same seed, refused when broken."""

import json
from dataclasses import replace

import numpy as np
import pytest
from hannes_description.errors import HannesError
from hannes_stiffness.classifier import (
    NOT_SURE,
    SHIPPED,
    Answers,
    StiffnessClassifier,
    class_label,
    save,
)
from hannes_stiffness.features import WINDOW, FeatureSpec
from hannes_stiffness.models import (
    METHODS,
    Calibration,
    TrainingData,
    TreeSettings,
    apply_rules,
    class_weights,
    cross_validate,
    fit,
    fit_estimator,
    grouped_folds,
    weighted_quantile,
)

SMALL = TreeSettings(trees=8, leaves=32)


def synthetic(closures: int = 30, seed: int = 0) -> TrainingData:
    """Samples of three kinds: the current over the encoder rises not at all, steeply or gently."""
    rng = np.random.default_rng(seed)
    values, labels, groups = [], [], []
    for k in range(closures):
        kind = k % 3
        encoder = np.sort(rng.uniform(0.0, 14.0, 60))
        contact = rng.uniform(4.0, 9.0)
        rise = np.maximum(0.0, encoder - contact) * (0.0, 0.8, 0.15)[kind]
        current = 0.24 + rise + 0.02 * rng.standard_normal(60)
        values.append(np.column_stack([current, encoder + 0.5 + rise, encoder]))
        labels.append(np.where(current < 0.3, 0, kind))
        groups.append(np.full(60, k))
    x = np.concatenate(values).astype(np.float32)
    return TrainingData(x, np.concatenate(labels), x[:, 0] < 0.3, np.concatenate(groups))


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    data = synthetic()
    trees = fit(data, seed=1, settings=SMALL)
    path = save(
        trees,
        tmp_path_factory.mktemp("classifier") / "small.onnx",
        method="bagged trees",
        spec=FeatureSpec(),
        seed=1,
        settings={"trees": 8},
        training={"closures": 30},
        scores={"f1": 0.5},
    )
    return data, trees, path


@pytest.fixture
def copy(saved, tmp_path):
    for suffix in (".onnx", ".json"):
        (tmp_path / f"c{suffix}").write_bytes(saved[2].with_suffix(suffix).read_bytes())
    return tmp_path / "c.onnx"


def test_onnx_answers_as_the_trees_do(saved):
    data, trees, path = saved
    loaded = StiffnessClassifier.load(path)
    rng = np.random.default_rng(5)
    edges = np.unique(np.concatenate([t.tree_.threshold for t in trees.estimators_]).astype(np.float32))
    # Also at the thresholds themselves, where a rounding of the stored ones would show.
    x = np.concatenate(
        [data.values, rng.uniform([0, 0, 0], [2, 15, 15], (2000, 3)), np.tile(edges[:, None], 3)]
    )
    x = x.astype(np.float32)
    never = np.zeros(len(x), bool)
    np.testing.assert_allclose(loaded.probabilities(x, never), trees.predict_proba(x), atol=1e-6)
    sure = np.ptp(np.sort(trees.predict_proba(x), axis=1)[:, 1:], axis=1) > 1e-5
    np.testing.assert_array_equal(loaded.classify(x, never)[sure], trees.predict(x)[sure])


def test_the_rules_stand_before_the_trees(saved):
    data, _, path = saved
    loaded = StiffnessClassifier.load(path)
    always = np.ones(len(data.values), bool)
    np.testing.assert_array_equal(
        loaded.probabilities(data.values, always), np.tile([1.0, 0.0, 0.0], (len(always), 1))
    )
    np.testing.assert_array_equal(
        apply_rules(np.array([[0.1, 0.9, 0.0]]), np.array([False])), [[0.1, 0.9, 0.0]]
    )
    assert loaded.probabilities(np.empty((0, 3)), []).shape == (0, 3)


def test_the_same_seed_gives_the_same_predictions_and_another_does_not(saved):
    data, trees, _ = saved
    again, other = fit(data, seed=1, settings=SMALL), fit(data, seed=2, settings=SMALL)
    np.testing.assert_array_equal(again.predict_proba(data.values), trees.predict_proba(data.values))
    assert (other.predict_proba(data.values) != trees.predict_proba(data.values)).any()
    np.testing.assert_array_equal(
        cross_validate(data, seed=1, settings=SMALL), cross_validate(data, seed=1, settings=SMALL)
    )


def test_cross_validation_never_sees_the_closure():
    # Labels that only the closure's number tells: trees that had seen it would know them.
    rng = np.random.default_rng(0)
    groups = np.repeat(np.arange(40), 20)
    labels = rng.integers(0, 3, 40)[groups]
    values = np.column_stack([np.ones(800), groups * 0.1, rng.uniform(0, 1, 800)]).astype(np.float32)
    data = TrainingData(values, labels, np.zeros(800, bool), groups)
    settings = TreeSettings(trees=5, leaves=256, leaf=1)
    assert (fit(data, seed=0, settings=settings).predict(values) == labels).mean() > 0.95
    held_out = cross_validate(data, seed=0, settings=settings)
    assert (held_out.argmax(axis=1) == labels).mean() < 0.6


def test_the_manifest_says_what_it_is(saved):
    manifest = StiffnessClassifier.load(saved[2]).manifest
    assert manifest["classes"] == ["void", "rigid", "soft"]
    assert manifest["features"]["version"] == "single-sample/1"
    assert manifest["features"]["current"] == "rectified"
    assert manifest["seed"] == 1
    assert manifest["onnx"]["bytes"] == saved[2].stat().st_size
    assert {"scikit-learn", "skl2onnx", "numpy"} <= set(manifest["versions"])


@pytest.mark.parametrize("where", [0, 100, -1])
def test_a_changed_onnx_file_is_refused(copy, where):
    content = bytearray(copy.read_bytes())
    content[where] ^= 0x10
    copy.write_bytes(content)
    with pytest.raises(HannesError, match="sha256"):
        StiffnessClassifier.load(copy)


def edit(copy, change):
    manifest = json.loads(copy.with_suffix(".json").read_text())
    change(manifest)
    copy.with_suffix(".json").write_text(json.dumps(manifest))


@pytest.mark.parametrize(
    "change, word",
    [
        (lambda m: m.update(schema="hannes/stiffness/99"), "schema"),
        (lambda m: m["features"].update(version="single-sample/0"), "version"),
        (lambda m: m["features"].update(current="cubed"), "rectified, signed"),
        (lambda m: m["features"].pop("mask"), "mask"),
        (lambda m: m.update(features=[1, 2]), "features"),
        (lambda m: m.update(classes=["void", "soft", "rigid"]), "classes"),
        (lambda m: m.update(feature_names=["a", "b", "c"]), "names the features"),
        (lambda m: m["features"].update(version="window/2"), "names the features"),
        (lambda m: m.update(sure=2.0), "sure"),
        (lambda m: m.pop("sure"), "sure"),
        (lambda m: m.update(calibration={"weights": [[1]], "bias": [0]}), "calibration"),
        (lambda m: m.update(interval_factor=-1.0), "interval_factor"),
        (lambda m: m.pop("onnx"), "hash"),
        (lambda m: m["onnx"].update(sha256="00"), "sha256"),
    ],
)
def test_a_wrong_manifest_is_refused(copy, change, word):
    edit(copy, change)
    with pytest.raises(HannesError, match=word):
        StiffnessClassifier.load(copy)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"null", b"\xff\xfe", b"[" * 100_000])
def test_a_broken_manifest_is_refused(copy, content):
    copy.with_suffix(".json").write_bytes(content)
    with pytest.raises(HannesError, match="manifest"):
        StiffnessClassifier.load(copy)


@pytest.mark.parametrize("content", [b"", b"not onnx at all", None])
def test_a_file_that_is_not_onnx_is_refused_even_with_the_right_hash(copy, content):
    import hashlib

    content = copy.read_bytes()[:500] if content is None else content
    copy.write_bytes(content)
    edit(copy, lambda m: m["onnx"].update(sha256=hashlib.sha256(content).hexdigest()))
    with pytest.raises(HannesError, match="ONNX"):
        StiffnessClassifier.load(copy)


def test_a_missing_file_is_refused(copy, tmp_path):
    copy.unlink()
    with pytest.raises(HannesError, match="Cannot read"):
        StiffnessClassifier.load(copy)
    with pytest.raises(HannesError, match=r"\.onnx"):
        StiffnessClassifier.load(tmp_path / "model.pkl")
    with pytest.raises(HannesError, match="Cannot read"):
        StiffnessClassifier.load(tmp_path / "none.onnx")


def test_unfit_training_data_are_refused():
    data = synthetic()
    with pytest.raises(HannesError, match="no sample of soft"):
        fit(replace(data, labels=np.minimum(data.labels, 1)), seed=0, settings=SMALL)
    with pytest.raises(HannesError, match="do not fit together"):
        replace(data, closures=data.closures[1:])
    with pytest.raises(HannesError, match="not finite"):
        replace(data, values=np.full_like(data.values, np.nan))
    with pytest.raises(HannesError, match="too few"):
        cross_validate(replace(data, closures=data.closures % 3), seed=0, settings=SMALL)
    with pytest.raises(HannesError, match="trees"):
        TreeSettings(trees=0)


def test_samples_of_a_wrong_shape_are_refused(saved):
    loaded = StiffnessClassifier.load(saved[2])
    with pytest.raises(HannesError, match="shape"):
        loaded.probabilities(np.zeros((4, 2)), np.zeros(4, bool))


def windows(closures: int = 40, seed: int = 0) -> TrainingData:
    """Samples with the features of a window, of which the first tells the class and the second the stiffness."""
    rng = np.random.default_rng(seed)
    n = 60 * closures
    number = np.repeat(np.arange(closures), 60)
    exponent = rng.uniform(2.0, 5.0, closures)[number]
    labels = np.where(number % 4 == 0, 0, np.where(exponent > 4.26, 1, 2))
    values = rng.normal(size=(n, len(FeatureSpec(version=WINDOW).names)))
    values[:, 0] = labels + 0.2 * rng.standard_normal(n)
    values[:, 1] = exponent + 0.05 * rng.standard_normal(n)
    stiffness = np.where(number % 4 == 0, np.nan, 10.0**exponent)
    return TrainingData(
        values.astype(np.float32), labels, rng.random(n) < 0.1, number, number // 2, number % 7, stiffness
    )


@pytest.fixture(scope="module")
def window_file(tmp_path_factory):
    data = windows()
    model, estimator = fit(data, seed=1, method="network"), fit_estimator(data, seed=1, folds=3)
    calibration = Calibration.fit(model.predict_proba(data.values), data.labels)
    path = save(
        model,
        tmp_path_factory.mktemp("window") / "w.onnx",
        method="network",
        spec=FeatureSpec(version=WINDOW),
        seed=1,
        settings={},
        training={},
        scores={},
        calibration=calibration,
        sure=0.9,
        estimator=estimator,
    )
    return data, model, calibration, estimator, path


def test_one_file_answers_class_stiffness_and_interval(window_file):
    data, model, calibration, estimator, path = window_file
    loaded = StiffnessClassifier.load(path)
    answers = loaded.answer(data.values, data.void)
    expected = apply_rules(calibration.apply(model.predict_proba(data.values)), data.void)
    np.testing.assert_allclose(answers.probabilities, expected, atol=2e-4)
    assert np.isnan(answers.stiffness[data.void]).all()
    rows = estimator.rows
    value, low, high = answers.stiffness[rows].T
    np.testing.assert_allclose(
        np.log10(value), estimator.value.predict(data.values[rows]).clip(2, 5), atol=1e-4
    )
    assert ((low <= value) & (value <= high)).all()
    truth = data.stiffness[rows]
    assert np.mean((low <= truth) & (truth <= high)) > 0.85
    assert loaded.least == 0.9


def test_held_out_errors_give_the_interval(window_file):
    data, _, _, estimator, _ = window_file
    error = np.abs(np.log10(data.stiffness[estimator.rows]) - estimator.held_out[:, 0])
    inside = error <= estimator.factor * estimator.held_out[:, 1]
    assert 0.87 < inside.mean() < 0.93


def test_not_sure_below_the_least_probability():
    answers = Answers(np.array([[0.2, 0.5, 0.3], [0.0, 0.1, 0.9], [1.0, 0.0, 0.0]]), np.full((3, 3), np.nan))
    np.testing.assert_array_equal(answers.sure(0.6), [NOT_SURE, 2, 0])
    np.testing.assert_array_equal(answers.sure(0.0), [1, 2, 0])
    assert [class_label(k) for k in (NOT_SURE, 0, 1, 2)] == ["not sure", "void", "rigid", "soft"]


def test_calibration_mends_what_is_too_sure():
    rng = np.random.default_rng(0)
    truth = rng.dirichlet((1.0, 1.0, 1.0), 20_000)
    labels = np.array([rng.choice(3, p=p) for p in truth])
    bold = truth**3 / (truth**3).sum(axis=1, keepdims=True)
    mended = Calibration.fit(bold, labels).apply(bold)
    assert np.abs(mended - truth).mean() < 0.25 * np.abs(bold - truth).mean()
    np.testing.assert_allclose(Calibration.none().apply(truth.clip(1e-4)), truth, atol=1e-3)


@pytest.mark.parametrize("grouping", ["closures", "objects", "hands"])
def test_folds_split_no_group(grouping):
    groups = getattr(windows(), grouping)
    seen = np.zeros(len(groups), int)
    for training, held_out in grouped_folds(groups, 3, 0):
        assert not set(groups[training]) & set(groups[held_out])
        seen += held_out
    assert (seen == 1).all()


@pytest.mark.parametrize("method", [name for name in METHODS if name != "thesis"])
def test_every_method_on_windows_learns_and_converts(method, tmp_path):
    data = windows()
    model = fit(data, seed=0, settings=SMALL, method=method)
    path = save(
        model,
        tmp_path / "m.onnx",
        method=method,
        spec=FeatureSpec(version=WINDOW),
        seed=0,
        settings={},
        training={},
        scores={},
    )
    never = np.zeros(len(data.values), bool)
    answers = StiffnessClassifier.load(path).answer(data.values, never)
    np.testing.assert_allclose(answers.probabilities, model.predict_proba(data.values), atol=2e-4)
    assert (answers.classes == data.labels).mean() > 0.85
    assert np.isnan(answers.stiffness).all()


def test_rigid_and_soft_weigh_alike_and_void_as_often_as_it_comes():
    labels = np.array([0] * 5 + [1] * 10 + [2] * 30)
    weight = class_weights(labels)
    np.testing.assert_allclose([weight[labels == k].sum() for k in range(3)], [5.0, 20.0, 20.0])


def test_weighted_quantile():
    values = np.array([3.0, 1.0, 2.0])
    assert weighted_quantile(values, np.ones(3), 0.5) == 2.0
    assert weighted_quantile(values, np.array([8.0, 1.0, 1.0]), 0.5) == 3.0


def test_what_ships_is_small_and_estimates():
    loaded = {name: StiffnessClassifier.load(name) for name in SHIPPED}
    assert sum(c.manifest["onnx"]["bytes"] for c in loaded.values()) < 1_500_000
    assert loaded["window"].estimates
    assert not loaded["baseline"].estimates
