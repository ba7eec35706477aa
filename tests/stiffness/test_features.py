"""Features: the streaming code and the array code are the same, also over gaps, restarts, rates and bad
values."""

import numpy as np
import pytest
from hannes_description.errors import HannesError
from hannes_stiffness.features import FEATURES, WINDOW, FeatureSpec, FeatureStream, extract, hold


def closure(rate: float, duration: float = 8.0, seed: int = 0, jitter: float = 0.0):
    """Half-sine references of 4 s, a lagging encoder and a noisy signed current."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, duration, 1.0 / rate)
    t = t + rng.uniform(-jitter, jitter, len(t)) / rate
    reference = np.maximum(0.0, 14.57 * np.sin(2 * np.pi * 0.25 * t))
    encoder = np.maximum(0.0, 13.0 * np.sin(2 * np.pi * 0.25 * (t - 0.05)))
    current = 0.4 * np.cos(2 * np.pi * 0.25 * t) + 0.05 * rng.standard_normal(len(t))
    return t, current, reference, encoder


def stream(arrays, spec=None, rate=None):
    feed = FeatureStream(spec or FeatureSpec(), rate)
    samples = [s for s in (feed.push(*map(float, row)) for row in zip(*arrays, strict=True)) if s is not None]
    return feed, samples


def assert_same(arrays, spec=None, rate=None):
    feed, samples = stream(arrays, spec, rate)
    batch = extract(*arrays, spec, rate)
    assert len(samples) == len(batch.time)
    np.testing.assert_array_equal([s.time for s in samples], batch.time)
    np.testing.assert_array_equal(
        np.array([s.values for s in samples], np.float32).reshape(batch.values.shape), batch.values
    )
    np.testing.assert_array_equal(np.array([s.void for s in samples], bool), batch.void)
    assert (feed.rejected, feed.restarts) == (batch.rejected, batch.restarts)
    return batch


@pytest.mark.parametrize("rate", [5.0, 20.0, 29.0, 30.0, 31.0, 50.0, 100.0, 300.0, 1000.0])
@pytest.mark.parametrize("jitter", [0.0, 0.1, 0.45])
@pytest.mark.parametrize("current", ["rectified", "signed"])
@pytest.mark.parametrize("version", FEATURES)
def test_stream_equals_arrays_at_every_rate(rate, jitter, current, version):
    batch = assert_same(closure(rate, jitter=jitter), FeatureSpec(current=current, version=version))
    assert len(batch.time) <= 8.0 * min(rate, 30.0) + 2


@pytest.mark.parametrize("rate", [7.0, 30.0, 100.0, 1000.0])
@pytest.mark.parametrize("version", FEATURES)
def test_answers_may_come_at_another_rate_with_the_same_meaning(rate, version):
    arrays = closure(1000.0)
    spec = FeatureSpec(version=version)
    batch = assert_same(arrays, spec, rate=rate)
    np.testing.assert_allclose(len(batch.time), 8.0 * rate, atol=1)
    dense = extract(*arrays, spec, rate=1000.0)
    same = np.searchsorted(dense.time, batch.time)
    np.testing.assert_array_equal(dense.values[same], batch.values)
    np.testing.assert_array_equal(dense.void[same], batch.void)


def test_stream_equals_arrays_over_gaps_restarts_and_bad_values():
    t, i, r, q = closure(100.0)
    rng = np.random.default_rng(3)
    t = t.copy()
    t[300:] += 1.0  # a hole
    t[500:] -= 3.0  # a bag played again
    t[600:] = t[600:] - 0.05  # a little out of order: dropped until it is past
    for values, bad in ((i, np.nan), (r, np.inf), (q, 1e9), (t, np.nan), (i, -1e300)):
        values[rng.integers(0, len(t), 5)] = bad
    assert_same((t, i, r, q), FeatureSpec(version=WINDOW))
    batch = assert_same((t, i, r, q))
    assert batch.restarts == 2
    assert batch.rejected >= 20
    assert np.isfinite(batch.values).all()


@pytest.mark.parametrize("seed", range(20))
def test_stream_equals_arrays_on_random_clocks(seed):
    rng = np.random.default_rng(seed)
    n = 400
    t = np.cumsum(
        rng.choice(
            [0.001, 0.01, 0.033, 0.0, -0.02, 0.2, 0.3, -0.5],
            n,
            p=[0.4, 0.2, 0.2, 0.05, 0.05, 0.05, 0.03, 0.02],
        )
    )
    arrays = (t, rng.normal(0, 1, n), np.cumsum(rng.normal(0, 0.1, n)), np.cumsum(rng.normal(0, 0.1, n)))
    for version in FEATURES:
        assert_same(arrays, FeatureSpec(version=version))


def test_samples_come_at_the_trained_rate_and_average_the_current():
    t = np.arange(3000) / 1000.0
    ripple = 0.5 + 0.3 * (-1.0) ** np.arange(3000)
    batch = extract(t, ripple, np.zeros(3000), np.zeros(3000))
    assert abs(len(batch.time) - 90) <= 1
    np.testing.assert_allclose(batch.values[1:, 0], 0.5, atol=0.02)


def test_thirty_hertz_passes_unchanged():
    t, i, r, q = closure(30.0, jitter=0.04)
    batch = extract(t, i, r, q)
    np.testing.assert_array_equal(batch.values, np.column_stack([np.abs(i), r, q]).astype(np.float32))


def test_below_the_void_current_is_void():
    t = np.arange(100) / 30.0
    batch = extract(t, np.linspace(0.25, 0.35, 100), np.zeros(100), np.zeros(100))
    np.testing.assert_array_equal(batch.void, np.linspace(0.25, 0.35, 100) < 0.3)


def test_the_start_of_each_closure_is_void_and_nothing_else():
    t = np.arange(240) / 30.0
    reference = np.maximum(0.0, 14.57 * np.sin(2 * np.pi * 0.25 * t))
    batch = extract(t, np.full(240, 1.0), reference, reference)
    starts = np.flatnonzero(np.diff(batch.void.astype(int)) == 1) + 1
    np.testing.assert_allclose(t[starts], [1 / 30, 4 + 1 / 30], atol=1e-9)
    assert batch.void.sum() == 2 * 6


def test_rectified_and_signed_current():
    t = np.arange(90) / 30.0
    arrays = (t, np.full(90, -0.5), np.zeros(90), np.zeros(90))
    assert (extract(*arrays, FeatureSpec()).values[:, 0] == 0.5).all()
    signed = extract(*arrays, FeatureSpec(current="signed"))
    assert (signed.values[:, 0] == -0.5).all()
    assert not signed.void.any()


def test_hold_never_looks_ahead_and_forgets_old_values():
    out = hold([1.0, 1.1, 1.2], [10.0, 11.0, 12.0], [0.99, 1.0, 1.15, 1.2, 1.44, 2.0])
    np.testing.assert_array_equal(out, [np.nan, 10.0, 11.0, 12.0, 12.0, np.nan])
    assert np.isnan(hold([], [], [1.0])).all()


@pytest.mark.parametrize(
    "change, word",
    [
        ({"current": "squared"}, "rectified"),
        ({"version": "other/9"}, "version"),
        ({"rate": 0.0}, "rate"),
        ({"rate": float("nan")}, "rate"),
        ({"mask": "long"}, "mask"),
        ({"void_current": True}, "void_current"),
    ],
)
def test_a_wrong_setting_is_named(change, word):
    with pytest.raises(HannesError, match=word):
        FeatureSpec(**change)


def test_a_rate_that_cannot_be_is_refused():
    with pytest.raises(HannesError, match="rate of answers"):
        FeatureStream(rate=0.0)


def test_arrays_of_different_length_are_refused():
    with pytest.raises(HannesError, match="one length"):
        extract([0.0, 1.0], [0.0], [0.0, 0.0], [0.0, 0.0])


def test_nothing_in_nothing_out():
    assert len(extract([], [], [], []).time) == 0
    assert extract([np.nan], [0.0], [0.0], [0.0]).rejected == 1


def grasp(slope: float, contact: float = 8.0, free: float = 0.2, n: int = 45):
    """A slow closure at 10 rad/s and 30 Hz: the current is the nominal free one, then rises by `slope` A/rad."""
    from hannes_stiffness.window import INERTIA, SPRING, VISCOUS

    t = np.arange(n) / 30.0
    q = 10.0 * t
    i = free + VISCOUS * 10.0 + SPRING * q + slope * np.maximum(0.0, q - contact)
    assert INERTIA > 0.0
    return t, i, q + 0.5, q


@pytest.mark.parametrize("slope", [0.06, 0.3, 1.5])
def test_a_window_sees_slopes_and_the_grasp_its_line(slope):
    spec = FeatureSpec(version=WINDOW, mask=0.0)
    t, i, r, q = grasp(slope)
    batch = extract(t, i, r, q, spec)
    last = dict(zip(spec.names, batch.values[-1], strict=True))
    per_radian = 0.01 * np.expm1(last["loading_line"])
    # The first sample above the free level is up to LIFT high, so that the line starts a little late.
    np.testing.assert_allclose(per_radian, slope, rtol=0.1)
    np.testing.assert_allclose(0.2 * np.expm1(last["current_slope"]), 10.0 * (slope + 0.0094), rtol=0.01)
    np.testing.assert_allclose(last["encoder_velocity"], 10.0, rtol=1e-4)
    np.testing.assert_allclose(last["tracking_error"], 0.5, rtol=1e-4)
    np.testing.assert_allclose(last["current_range"], i[-1] - i[-7], rtol=1e-4)
    assert 8.0 - 0.5 <= last["contact_encoder"] <= 8.0 + 0.05 / slope + 0.35
    # It follows a gentle rise until `LIFT` tells it from the free level.
    np.testing.assert_allclose(last["free_level"], 0.2, atol=0.03)


@pytest.mark.parametrize(("spring", "damper"), [(0.06, 0.0), (0.06, 0.05), (0.5, 0.02)])
def test_a_damper_is_told_from_a_spring_where_the_hand_slows_down(spring, damper):
    from hannes_stiffness.window import SPRING, VISCOUS

    spec = FeatureSpec(version=WINDOW, mask=0.0)
    # Velocity falls from 10 rad/s to nearly nothing, as at the end of a half sine.
    t = np.arange(40) / 30.0
    q = 12.0 * np.sin(10.0 / 12.0 * t)
    middle = t - 0.5 / 30.0  # an averaged current belongs to the middle of its step
    v = 10.0 * np.cos(10.0 / 12.0 * middle)
    x = np.maximum(0.0, q - 4.0)
    i = 0.2 + VISCOUS * v + SPRING * q + spring * x + damper * v * (x > 0.0)
    batch = extract(t, i, q + 0.5, q, spec)
    last = dict(zip(spec.names, batch.values[-1], strict=True))
    k, c = 0.01 * np.expm1(last["viscoelastic_stiffness"]), 0.01 * np.expm1(last["viscoelastic_damping"])
    np.testing.assert_allclose(k, spring, rtol=0.15)
    np.testing.assert_allclose(c, damper, atol=0.015)


def test_what_rises_before_the_contact_is_expected_to_go_on():
    from hannes_stiffness.window import VISCOUS

    spec = FeatureSpec(version=WINDOW, mask=0.0)
    t = np.arange(45) / 30.0
    q = 10.0 * t
    glove = 0.02  # A/rad more than the nominal springs need: slow enough for the free level to follow
    i = 0.1 + VISCOUS * 10.0 + (0.0094 + glove) * q
    last = dict(zip(spec.names, extract(t, i, q + 0.5, q, spec).values[-1], strict=True))
    np.testing.assert_allclose(last["free_slope"], glove, rtol=0.1)
    np.testing.assert_allclose(last["load_above_free_line"], 0.0, atol=0.02)


def test_nothing_grasped_shows_no_contact():
    spec = FeatureSpec(version=WINDOW, mask=0.0)
    batch = extract(*grasp(0.0), spec)
    last = dict(zip(spec.names, batch.values[-1], strict=True))
    assert abs(last["load_above_free"]) < 0.01
    assert last["largest_rise"] == 0.0


def test_a_ripple_of_the_reference_is_no_new_closure_and_a_new_closure_forgets():
    spec = FeatureSpec(version=WINDOW)
    t = np.arange(300) / 30.0
    ripple = 10.0 + 1.0 * np.sin(2.0 * np.pi * 1.5 * t)
    reference = np.where(
        t < 5.0, ripple, np.maximum(0.0, 14.0 * np.sin(2.0 * np.pi * 0.25 * (t - 6.0)) * (t > 6.0))
    )
    batch = extract(t, np.full(300, 1.0), reference, reference, spec)
    starts = t[np.flatnonzero(np.diff(batch.void.astype(int)) == 1) + 1]
    assert len(starts[starts > 0.5]) == 1
    assert 6.0 < starts[-1] < 6.2


def test_a_stream_takes_whole_numbers() -> None:
    """A reference of 5 rad is one, whoever writes it without a point."""
    streams = [FeatureStream(FeatureSpec(version=WINDOW)) for _ in range(2)]
    for k in range(30):
        assert streams[0].push(0.04 * k, 1, 5, 1) == streams[1].push(0.04 * k, 1.0, 5.0, 1.0)
