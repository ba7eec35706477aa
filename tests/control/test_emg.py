"""EMG to reference: causal equals vectorised, thresholds, limits, co-contraction, synthetic and real, bad files."""

from pathlib import Path

import numpy as np
import pytest
from hannes_control.emg import (
    EmgIntegrator,
    EmgParameters,
    EmgRecording,
    SyntheticEmg,
    emg_reference,
    envelope,
    read_emg_csv,
    synthesise,
)
from hannes_control.reference import FULL_CLOSURE
from hannes_description.errors import HannesError


@pytest.fixture(scope="module")
def recording() -> EmgRecording:
    return synthesise(SyntheticEmg(closures=2, cocontraction=0.4), seed=3)


def test_sample_by_sample_equals_vectorised(recording):
    whole = emg_reference(recording.flexor, recording.extensor)
    one = EmgIntegrator()
    stepped = [one.update(f, e) for f, e in zip(recording.flexor, recording.extensor, strict=True)]
    np.testing.assert_allclose(stepped, whole.reference, rtol=0, atol=1e-12)
    assert one.switches == len(whole.switches) == 2


def test_envelope_of_a_steady_contraction_is_its_mean_rectified_value():
    steady = synthesise(SyntheticEmg(close=30.0, effort=1.0, amplitude=2.0), seed=1)
    level = envelope(steady.flexor, EmgParameters())[3000:8000]
    assert level.mean() == pytest.approx(2.0, rel=0.05)


def test_full_scale_makes_units_irrelevant(recording):
    volts = emg_reference(recording.flexor, recording.extensor)
    five = emg_reference(5.0 * recording.flexor, 5.0 * recording.extensor, EmgParameters(full_scale=5.0))
    np.testing.assert_allclose(five.reference, volts.reference, atol=1e-9)


def test_closes_fully_holds_and_opens(recording):
    reference = emg_reference(recording.flexor, recording.extensor).reference
    assert reference.min() == 0.0
    assert reference.max() == FULL_CLOSURE
    held = reference[int(2.4 * 300) : int(2.9 * 300)]
    np.testing.assert_array_equal(held, FULL_CLOSURE)
    assert reference[int(5.3 * 300)] == 0.0


def constant(flexor: float, extensor: float, seconds: float = 2.0, **options: float):
    n = int(300 * seconds)
    return emg_reference(np.full(n, flexor), np.full(n, extensor), EmgParameters(**options))


def test_speed_is_proportional_above_the_dead_band():
    slow, fast = (constant(level, 0.0, max_position=1e6).reference for level in (0.5, 0.9))
    speeds = [(r[-1] - r[-301]) for r in (slow, fast)]
    assert speeds == pytest.approx([15.0 * 0.4, 15.0 * 0.8], rel=1e-6)


def test_below_the_threshold_nothing_moves():
    assert constant(0.38, 0.0).reference[-1] == 0.0  # the low-pass overshoots a step by 4 %


def test_the_extensor_must_exceed_the_flexor_to_open():
    assert constant(0.48, 0.45).reference[-1] > 1.0
    assert constant(0.45, 0.48).reference[-1] == pytest.approx(0.0, abs=0.2)


def test_cocontraction_is_one_event_and_holds_the_reference():
    both = constant(0.9, 0.9)
    assert len(both.switches) == 1
    assert both.reference[both.switches[0]] == both.reference[-1]


def test_reset_repeats_bit_for_bit(recording):
    one = EmgIntegrator()
    first = [one.update(f, e) for f, e in zip(recording.flexor, recording.extensor, strict=True)]
    one.reset()
    assert first == [one.update(f, e) for f, e in zip(recording.flexor, recording.extensor, strict=True)]


def test_synthetic_emg_is_seeded_and_band_limited():
    a, b, c = (synthesise(SyntheticEmg(), seed=s).flexor for s in (1, 1, 2))
    np.testing.assert_array_equal(a, b)
    assert not np.array_equal(a, c)
    power = np.abs(np.fft.rfft(a)) ** 2
    frequency = np.fft.rfftfreq(a.size, 1 / 300)
    assert power[frequency < 10].sum() < 0.02 * power.sum()


def test_the_real_recording_closes_and_opens_the_hand(hannes_data: Path):
    real = read_emg_csv(hannes_data / "emg" / "emg2ch_close_open_u1d1p1_300Hz.csv")
    assert real.rate == 300.0
    reference = emg_reference(real.flexor, real.extensor).reference
    full, empty = reference > 0.95 * FULL_CLOSURE, reference < 0.05 * FULL_CLOSURE
    state = np.where(full, 1, np.where(empty, -1, 0))
    changes = state[state != 0]
    assert np.count_nonzero(np.diff(changes) > 0) >= 8


def test_resampling_keeps_the_signal():
    t = np.arange(1000) / 500.0
    tone = EmgRecording(500.0, np.sin(2 * np.pi * 5 * t), np.cos(2 * np.pi * 5 * t))
    at300 = tone.resampled(300)
    expected = np.sin(2 * np.pi * 5 * np.arange(600) / 300.0)
    np.testing.assert_allclose(at300.flexor[60:-60], expected[60:-60], atol=5e-3)
    assert tone.resampled(500) is tone


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("t_s,close\n0,1\n", "no column 'open'"),
        ("", "no column 't_s'"),
        ("t_s,close,open\n0,1,x\n", "line 2: open is 'x', not a number"),
        ("t_s,close,open\n0,1,nan\n", "open is nan"),
        ("t_s,close,open\n0,1\n", "line 2: open is None"),
        ("t_s,close,open\n0,1,1\n0,1,1\n", "line 3: the time 0.0 s is not after"),
        ("t_s,close,open\n0,1,1\n", "1 samples"),
        (
            "t_s,close,open\n" + "".join(f"{k / 100 + (k > 9)},0,0\n" for k in range(20)),
            "samples are missing after t = 0.09",
        ),
        ("t_s,close,open\n\xff\xfe", "not a number|Cannot read"),
    ],
)
def test_bad_files_give_one_clear_error(tmp_path: Path, text: str, message: str):
    path = tmp_path / "emg.csv"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(HannesError, match=message):
        read_emg_csv(path)


def test_a_table_as_spreadsheets_write_it_is_read(tmp_path: Path):
    path = tmp_path / "emg.csv"
    rows = "".join(f"{k / 100},{k},0\r\n" for k in range(20))
    path.write_text("t_s,close,open\r\n" + rows, encoding="utf-8-sig", newline="")
    assert read_emg_csv(path).flexor[3] == 3.0


def test_missing_file(tmp_path: Path):
    with pytest.raises(HannesError, match=r"Cannot read the EMG file '.*none.csv'"):
        read_emg_csv(tmp_path / "none.csv")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rate": 0.0}, "'rate' is 0"),
        ({"envelope_cutoff": 200.0}, "below half the rate"),
        ({"speed": float("nan")}, "'speed' is nan"),
        ({"close_threshold": 0.05}, "at least the dead band"),
    ],
)
def test_bad_parameters_are_named(options, message):
    with pytest.raises(HannesError, match=message):
        EmgParameters(**options)


def test_not_finite_sample_is_refused():
    with pytest.raises(HannesError, match="not finite"):
        EmgIntegrator().update(float("nan"), 0.0)
    with pytest.raises(HannesError, match="extensor EMG is not finite at sample 1"):
        emg_reference(np.zeros(3), np.array([0.0, np.inf, 0.0]))


def test_more_synthetic_emg_than_memory_holds_is_refused() -> None:
    with pytest.raises(HannesError, match=r"1.2e\+08 samples at 300 Hz; at most 100000000 are made"):
        synthesise(SyntheticEmg(closures=80_000, close=1.6, hold=1.0, open=1.6, rest=0.8), seed=0)
