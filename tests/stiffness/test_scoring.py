"""Scores: the usual formulas, the thesis' windows in both readings."""

import numpy as np
import pytest
from hannes_description.errors import HannesError
from hannes_stiffness.scoring import HOPS, mode, pool, score, score_closures, windows


def test_formulas_by_hand():
    truth = [0, 0, 1, 1, 1, 2, 2, 2, 2, 2]
    answer = [0, 1, 1, 1, 2, 2, 2, 2, 0, 1]
    s = score(truth, answer)
    np.testing.assert_array_equal(s.confusion, [[1, 1, 0], [0, 2, 1], [1, 1, 3]])
    rigid = s.classes["rigid"]
    assert (rigid.precision, rigid.recall, rigid.support) == (2 / 4, 2 / 3, 3)
    assert rigid.f1 == pytest.approx(2 * 0.5 * (2 / 3) / (0.5 + 2 / 3))
    assert s.accuracy == 0.6


def test_equal_to_scikit_learn():
    metrics = pytest.importorskip("sklearn.metrics")
    rng = np.random.default_rng(1)
    truth, answer = rng.integers(0, 3, 500), rng.integers(0, 3, 500)
    s = score(truth, answer)
    precision, recall, f1, support = metrics.precision_recall_fscore_support(truth, answer)
    for k, name in enumerate(("void", "rigid", "soft")):
        c = s.classes[name]
        np.testing.assert_allclose(
            [c.precision, c.recall, c.f1, c.support], [precision[k], recall[k], f1[k], support[k]]
        )
    assert s.macro_f1 == pytest.approx(metrics.f1_score(truth, answer, average="macro"))


def test_a_class_that_never_occurs_has_no_score_and_is_not_averaged():
    s = score([0, 0, 1], [0, 0, 1])
    assert np.isnan(s.classes["soft"].f1)
    assert s.macro_f1 == 1.0
    assert s.to_dict()["classes"]["soft"]["f1"] is None
    assert np.isnan(score([], []).macro_f1)


def test_pooling_adds_counts():
    a, b = score([0, 1], [0, 1]), score([2, 2, 2], [0, 0, 2])
    np.testing.assert_array_equal(pool([a, b]).confusion, a.confusion + b.confusion)
    assert pool([]).count == 0


def test_mode_takes_the_newest_of_equals():
    assert mode([1, 1, 2]) == 1
    assert mode([1, 2, 2, 1]) == 1
    assert mode([1, 1, 2, 2]) == 2
    assert mode([0, 1, 2, 0]) == 0
    with pytest.raises(HannesError, match="no mode"):
        mode([])


def test_windows_in_both_readings():
    t = np.arange(120) / 30.0
    labels = np.repeat([0, 1], 60)
    literal, dense = windows(t, labels, hop=HOPS["overlap_50ms"]), windows(t, labels, hop=HOPS["hop_50ms"])
    # (4.0 - 0.2) / 0.15 = 25.3 and (4.0 - 0.2) / 0.05 = 76
    assert len(literal.end) == 26
    assert len(dense.end) == 77
    np.testing.assert_allclose(np.diff(literal.end), 0.15)
    assert literal.labels.shape == (1, 26)
    # The first window that holds more ones than zeros: [1.9, 2.1) is a tie, and the newest wins.
    assert dense.end[np.flatnonzero(dense.labels[0])[0]] == pytest.approx(2.1)


def test_windows_skip_holes_and_need_one_whole_window():
    t = np.r_[np.arange(30), np.arange(60, 90)] / 30.0
    cut = windows(t, np.zeros(60, int), hop=0.15)
    assert not np.any((cut.end > 1.25) & (cut.end < 1.95))
    assert len(windows(t[:3], np.zeros(3, int), hop=0.15).end) == 0
    assert len(windows([], [], hop=0.15).end) == 0


def test_closures_pool_per_object():
    t = np.arange(60) / 30.0
    right, wrong = np.ones(60, int), np.full(60, 2)
    result = score_closures(
        [("block", t, right, right), ("ball", t, wrong, wrong), ("ball", t, wrong, right)], 0.15
    )
    assert list(result.objects) == ["block", "ball"]
    assert result.objects["block"].macro_f1 == 1.0
    assert result.objects["ball"].classes["soft"].recall == 0.5
    assert result.pooled.count == sum(s.count for s in result.objects.values())


@pytest.mark.parametrize(
    "call",
    [
        lambda: score([0, 3], [0, 0]),
        lambda: score([0], [0, 0]),
        lambda: score([[0]], [0]),
        lambda: windows([0.0], [0], hop=0.0),
        lambda: windows([0.0, 1.0], [0], hop=0.1),
    ],
)
def test_bad_labels_are_refused(call):
    with pytest.raises(HannesError):
        call()
