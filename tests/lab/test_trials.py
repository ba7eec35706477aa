"""From recordings to trials: reference on the grid, closures, conditions, outliers."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from hannes_bags.recording import Channel, Recording
from hannes_control.reference import half_sine
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_lab.adapter import check_trials
from hannes_lab.blocks import in_blocks, told_apart
from hannes_lab.cli_trials import told
from hannes_lab.closures import find_closures, group_closures
from hannes_lab.compare import compare
from hannes_lab.gaps import lost_part
from hannes_lab.hand import make_controller
from hannes_lab.phases import PHASES, phase_of
from hannes_lab.prepare import prepare, without_outliers
from hannes_lab.recorded import make_trial
from hannes_lab.reference import reference_on_grid
from hannes_lab.trials import Closure, Trial, unique_names
from hannes_sim.factory import make_plant
from hannes_sim.rollout import rollout


def recording(
    reference: np.ndarray,
    rate: float,
    *,
    metadata: dict[str, object] | None = None,
    wobble: int = -1,
    by: float = 2.0,
) -> Recording:
    """Signals that follow the reference with a lag, logged at 30 Hz; closure `wobble` is disturbed."""
    time = np.arange(reference.size) * 1e-3
    at = np.arange(0.0, time[-1], 1.0 / rate)
    log = np.arange(0.0, time[-1], 1.0 / 30.0)
    position = np.interp(log - 0.05, time, reference)
    if wobble >= 0:
        start = 4.0 * wobble
        position += np.where((log > start) & (log < start + 2.0), by, 0.0)
    rng = np.random.default_rng(0)
    position = position + 2e-3 * rng.standard_normal(log.size)
    channels = {
        "reference_position": Channel(at, np.interp(at, time, reference), "rad", "reference_position"),
        "encoder_position": Channel(log, position, "rad", "encoder_position"),
        "motor_current": Channel(log, np.abs(position) * 0.02, "A", "motor_current"),
    }
    return Recording(channels, metadata or {}, "memory")


def test_conditions_one_after_the_other_in_a_bag_are_recordings_of_their_own() -> None:
    """Each may have its own object; what comes in turn, or describes itself, stays one recording."""
    up = np.interp(np.arange(0.0, 2.0, 1e-3), [0.0, 0.5, 1.2, 1.5, 2.0], [0.0, 0.0, 8.0, 8.0, 0.0])
    long = 1.2 * np.interp(np.arange(0.0, 2.6, 1e-3), [0.0, 0.5, 1.6, 1.9, 2.6], [0.0, 0.0, 8.0, 8.0, 0.0])
    still = np.zeros(800)
    reference = np.concatenate([*([up, still] * 3), *([long, still] * 2), still])
    starts = [0.5 + 2.8 * k for k in range(3)] + [3 * 2.8 + 0.5 + 3.4 * k for k in range(2)]
    names = ["s.1"] * 3 + ["s.2"] * 2
    closures = tuple(Closure(a, a + 2.2, name) for a, name in zip(starts, names, strict=True))
    time = np.arange(reference.size) * 1e-3
    signals = {"encoder_position": (time, reference.copy()), "motor_current": (time[::10], reference[::10])}
    whole = Trial("s", 1e-3, reference, signals, closures, notes=("said",))
    one, two = in_blocks(whole)
    assert (one.name, two.name) == ("s.1", "s.2") and (one.notes, two.notes) == (("said",), ())
    assert len(one.closures) == 3 and len(two.closures) == 2
    for part in (one, two):
        assert part.closures[-1].stop <= part.reference.size * 1e-3
    both = round(two.closures[0].start / 1e-3)
    assert one.reference.size + two.reference.size == reference.size + both, "up to where the second sets off"
    check_trials([one, two], "HandRig")
    for part, closure in ((one, closures[1]), (two, closures[4])):
        own = part.closures[1]
        for name in signals:
            phase = np.linspace(0.05, 2.0, 40)
            there, here = (
                np.interp(c.start + phase, *t.signals[name]) for t, c in ((whole, closure), (part, own))
            )
            assert here == pytest.approx(there, abs=1e-6), name
        tick = round(own.start / 1e-3)
        assert np.array_equal(
            part.reference[tick : tick + 1500], reference[round(closure.start / 1e-3) :][:1500]
        )
    assert two.reference[0] == 0.0 and 0.4 < two.closures[0].start <= 0.5
    in_turn = tuple(replace(c, condition=f"s.{k % 2}") for k, c in enumerate(closures))
    broken = (*closures[:4], replace(closures[4], condition="s.3"))
    for other in (in_turn, broken):
        assert len(in_blocks(replace(whole, closures=other))) == 1
    assert len(in_blocks(replace(whole, options={"sensors": {}}))) == 1


def closures_with(travel: list[float], noise: float = 1e-3) -> Trial:
    """Closures with one reference, of which each goes so far and takes current for what it is kept from."""
    up = np.interp(np.arange(0.0, 2.8, 1e-3), [0.0, 0.5, 1.2, 1.5, 2.0], [0.0, 0.0, 8.0, 8.0, 0.0])
    time = np.arange(len(travel) * up.size) * 1e-3
    rng = np.random.default_rng(3)
    position = np.concatenate([np.minimum(up, most) for most in travel])
    log = time[::10]
    signals = {
        "encoder_position": (log, position[::10] + noise * rng.standard_normal(log.size)),
        "motor_current": (log, (1.1 * np.tile(up, len(travel)) - position)[::10]),
    }
    closures = tuple(Closure(0.5 + 2.8 * k, 0.5 + 2.8 * k + 2.0, "s") for k in range(len(travel)))
    return Trial("s", 1e-3, np.tile(up, len(travel)), signals, closures)


def test_closures_on_an_object_are_a_condition_of_their_own_though_the_reference_is_the_same() -> None:
    whole = told_apart(closures_with([8.0] * 5 + [5.0] * 4 + [6.5] * 2))
    assert {name: len(whole.of(name)) for name in whole.conditions} == {"s.1": 5, "s.2": 4, "s.3": 2}
    assert any("s.2 (4 closures from 14.5 s)" in note and "--object" in note for note in whole.notes)
    assert [part.name for part in in_blocks(whole)] == ["s.1", "s.2", "s.3"]


def test_a_soft_grasp_is_told_apart_beside_a_firm_one() -> None:
    """Beside the span that a firm grasp gives the current, what a soft one changes is little."""
    whole = told_apart(closures_with([8.0] * 5 + [7.4] * 5 + [1.0] * 5))
    assert [len(whole.of(name)) for name in whole.conditions] == [5, 5, 5]


def test_the_last_closure_of_a_block_may_last_until_the_next_block_begins() -> None:
    """Closures last until the next one sets off; half of the rest before a block belongs to both."""
    trial = closures_with([8.0] * 4 + [5.0] * 4)
    long = tuple(replace(c, stop=c.start + 2.8) for c in trial.closures[:-1])
    whole = told_apart(replace(trial, closures=(*long, trial.closures[-1])))
    one, two = check_trials(in_blocks(whole), "HandRig")
    assert len(one.closures) == len(two.closures) == 4
    assert one.closures[-1].stop == pytest.approx(one.reference.size * 1e-3)


@pytest.mark.parametrize(
    "travel",
    [
        pytest.param([8.0] * 4 + [5.0] + [8.0] * 4, id="an outlier"),
        pytest.param([5.0] + [8.0] * 5, id="the first"),
        pytest.param(list(np.linspace(8.0, 5.0, 9)), id="little by little"),
        pytest.param([8.0, 5.0] * 4, id="in turn"),
        pytest.param([8.0] * 4 + [7.95] * 4, id="hardly anything"),
    ],
)
def test_other_changes_from_closure_to_closure_make_no_conditions(travel: list[float]) -> None:
    trial = closures_with(travel)
    assert told_apart(trial) is trial


def test_what_a_recording_says_of_itself_is_not_doubted() -> None:
    trial = replace(closures_with([8.0] * 5 + [5.0] * 4), options={"sensors": {}})
    assert told_apart(trial) is trial


def test_closures_are_found_and_share_a_condition() -> None:
    trial = make_trial(recording(half_sine(5), 250.0, metadata={"condition": "slow"}))
    assert trial.conditions == ("slow",) and len(trial.closures) == 5
    starts = np.array([c.start for c in trial.closures])
    assert np.diff(starts) == pytest.approx(4.0, abs=0.01)


def test_a_grip_may_be_held_for_longer_than_the_hand_rests() -> None:
    """Rest is where the recording begins and ends, not where the reference is for most of the time."""
    up = np.linspace(0.0, 12.5, 1500)
    one = np.concatenate([up, np.full(2500, 12.5), up[::-1], np.zeros(600)])
    trial = make_trial(recording(np.concatenate([np.zeros(900), *([one] * 6)]), 250.0))
    assert len(trial.closures) == 6 and len(trial.conditions) == 1
    assert trial.closures[0].start == pytest.approx(0.9, abs=0.1)
    assert not any("cut off" in note for note in trial.notes)


def test_two_speeds_in_one_bag_are_two_conditions() -> None:
    reference = np.concatenate([half_sine(3), half_sine(4, period=2.0)])
    trial = make_trial(recording(reference, 250.0, metadata={"condition": "mix"}))
    assert len(trial.conditions) == 2
    assert sorted(len(trial.of(c)) for c in trial.conditions) == [3, 4]
    assert any(
        "2 conditions: mix.1 (3 closures), mix.2 (4 closures) (another amplitude" in note
        for note in trial.notes
    )


def test_a_closure_that_was_broken_off_is_a_condition_of_its_own_and_said() -> None:
    reference = half_sine(5)
    k = int(np.argmax(reference > 0.5 * reference.max()))
    reference[k : k + 3000] = 0.0
    trial = make_trial(recording(reference, 250.0, metadata={"condition": "slow"}))
    assert any(
        "2 conditions: slow.1 (1 closure), slow.2 (4 closures) (another amplitude, hold or rest, or one that was broken"
        in note
        for note in trial.notes
    ), trial.notes


def test_a_cut_off_closure_is_left_out_and_said() -> None:
    trial = make_trial(recording(half_sine(4)[:-2800], 250.0))
    assert len(trial.closures) == 3
    assert any("cut off" in note for note in trial.notes)


SIGNALS = ("reference_position", "encoder_position", "motor_current")


def without_samples(whole: Recording, begin: float, end: float, *names: str) -> Recording:
    kept = {}
    for name in names:
        channel = whole[name]
        keep = (channel.time <= begin) | (channel.time >= end)
        kept[name] = replace(channel, time=channel.time[keep], values=channel.values[keep])
    return replace(whole, channels={**whole.channels, **kept})


@pytest.mark.parametrize(
    ("begin", "end", "names", "left", "said"),
    [
        (5.0, 13.5, SIGNALS, 3, ["nothing was recorded from 5.00 to 13.50 s", "1 closure in which samples"]),
        (3.9, 4.6, SIGNALS, 5, ["nothing was recorded from 3.90 to 4.60 s", "1 closure in which samples"]),
        (5.0, 13.5, SIGNALS[1:], 3, ["3 closures in which samples are missing are left out"]),
        (
            7.9,
            16.1,
            SIGNALS[:1],
            4,
            ["reference_position has no sample from 7.90 to 16.10 s: it is guessed there"],
        ),
        (
            8.9,
            10.0,
            SIGNALS[:1],
            5,
            [
                "reference_position has no sample from 8.90 to 10.00 s: it is guessed there",
                "1 closure in which samples are missing is left out",
            ],
        ),
        (
            8.3,
            8.36,
            SIGNALS[:1],
            6,
            ["reference_position has no sample from 8.30 to 8.36 s: it is guessed there"],
        ),
        (8.02, 8.04, SIGNALS, 6, []),
    ],
)
def test_gaps_are_said(begin: float, end: float, names: tuple[str, ...], left: int, said: list[str]) -> None:
    """Also those in which a closure begins or ends, and closures of which nothing is left."""
    whole = recording(half_sine(6), 250.0)
    trial = make_trial(without_samples(whole, begin, end, *names))
    assert len(trial.closures) == left and len(trial.conditions) == 1
    assert len(trial.notes) == len(said)
    assert all(note.startswith(text) for note, text in zip(trial.notes, said, strict=True)), trial.notes


def test_a_reference_that_is_logged_only_where_it_changes_is_taken_as_it_is() -> None:
    """Every closure has a stretch without a message of it: none is left out for that."""
    slow, fast = (
        np.interp(np.arange(2500), [500, 500 + n, 1500, 1500 + n], [0, 12, 12, 0]) for n in (900, 60)
    )
    steps = np.concatenate([np.tile(slow, 8), np.tile(fast, 5)])
    whole = recording(steps, 1000.0)
    channel = whole["reference_position"]
    at = np.arange(0, channel.values.size, 10)
    jumps = at[np.flatnonzero(np.diff(channel.values[at], prepend=-1.0))]
    told = Channel(channel.time[jumps], channel.values[jumps], "rad", "reference_position")
    trial = make_trial(replace(whole, channels={**whole.channels, "reference_position": told}))
    assert [len(trial.of(name)) for name in trial.conditions] == [8, 5]
    assert not any("samples are missing" in note for note in trial.notes), trial.notes


def test_a_closure_unlike_the_others_in_which_samples_are_missing_is_said_to_be_that() -> None:
    pushed = recording(half_sine(6), 250.0, wobble=2)
    started = "1 closure(s) far from the others are left out, starting at 8.0 s"
    assert without_outliers(make_trial(pushed)).notes == (started,)
    short = make_trial(without_samples(pushed, 8.5, 8.61, "encoder_position"))
    assert without_outliers(short).notes == (started + " (samples of encoder_position are missing in it)",)


def test_where_the_source_of_the_reference_ended_is_no_rest() -> None:
    """A board that dies in the third closure: the last reference stands there for longer than the hand rests."""
    whole = recording(np.concatenate((half_sine(3), np.zeros(12000))), 250.0)
    channel = whole["reference_position"]
    there = np.asarray(channel.time) < 8.7
    died = Channel(channel.time[there], channel.values[there], "rad", "reference_position")
    trial = make_trial(replace(whole, channels={**whole.channels, "reference_position": died}))
    assert len(trial.closures) == 2 and trial.conditions == (trial.name,)
    assert [round(c.start) for c in trial.closures] == [0, 4]
    assert "the reference ends" in trial.notes[0] and "1 of 3 closures is cut off" in trial.notes[1]
    # a script that ends after its last motion: the hand rests, and is still recorded
    rests = np.asarray(channel.time) < 11.0
    ended = Channel(channel.time[rests], channel.values[rests], "rad", "reference_position")
    trial = make_trial(replace(whole, channels={**whole.channels, "reference_position": ended}))
    assert len(trial.closures) == 3 and not trial.notes


def test_gaps_in_every_closure_are_the_error() -> None:
    spoilt = recording(half_sine(3), 250.0)
    for k in range(3):
        spoilt = without_samples(spoilt, 4.0 * k + 1.0, 4.0 * k + 1.5 + 0.2 * k, "motor_current")
    with pytest.raises(
        HannesError, match=r"samples are missing in each of its closures; 'motor_current' has none for"
    ):
        make_trial(spoilt)


@pytest.mark.parametrize("rate", [30.0, 50.0])
def test_a_slow_log_of_the_reference_is_filled_smoothly(rate: float) -> None:
    truth = half_sine(2, amplitude=14.0)
    time = np.arange(truth.size) * 1e-3
    at = np.arange(0.013, time[-1], 1.0 / rate)
    filled, note = reference_on_grid(at, np.interp(at, time, truth), 1e-3, float(time[-1]))
    error = np.abs(filled[200:] - truth[200 : filled.size])
    linear = np.abs(np.interp(time[200:], at, np.interp(at, time, truth)) - truth[200:])
    assert note is not None
    assert np.sqrt((error**2).mean()) < 0.5 * np.sqrt((linear**2).mean())


def test_a_rate_is_told_right_where_stamps_are_whole_milliseconds() -> None:
    at = np.round(np.arange(0.0, 3.0, 1.0 / 60.0), 3)
    note = reference_on_grid(at, np.sin(at), 1e-3, 2.9)[1]
    assert note is not None and "logged at 60 Hz" in note


@pytest.mark.parametrize("rate", [50.0, 200.0])
def test_of_messages_of_one_instant_the_last_holds(rate: float) -> None:
    """A recorder that stamps what it receives may give two messages that came together the same stamp."""
    at = np.arange(0.0, 1.0, 1.0 / rate)
    values = np.minimum(at, 1.0 - at)
    twice = np.sort(np.concatenate([at, at[20:23]]))
    last = np.searchsorted(twice, at, side="right") - 1
    given = np.full(twice.size, 0.7)
    given[last] = values
    for hold_rate in (10.0, 1e4):
        doubled, _ = reference_on_grid(twice, given, 1e-3, 0.9, hold_rate)
        single, _ = reference_on_grid(at, values, 1e-3, 0.9, hold_rate)
        assert np.array_equal(doubled, single)


def test_a_fast_log_is_held_as_the_controller_does() -> None:
    at = np.arange(0.0, 1.0, 0.01)
    filled, note = reference_on_grid(at, np.arange(100.0), 1e-3, 0.999)
    assert filled[15] == 1.0 and filled[19] == 1.0 and filled[20] == 2.0
    assert note is not None and "100 Hz; each message is held" in note
    fast = np.arange(0.0, 1.0, 0.004)
    assert reference_on_grid(fast, fast, 1e-3, 0.9)[1] is None


def test_a_recording_may_say_whether_its_reference_is_held() -> None:
    said: tuple[dict[str, object], ...] = ({"reference_held": True}, {"reference_held": False}, {})
    held, filled, unsaid = (
        make_trial(recording(half_sine(3), 100.0, metadata={"condition": "slow", **meta})).reference
        for meta in said
    )
    assert np.unique(held).size < np.unique(filled).size / 5
    assert np.array_equal(unsaid, filled)
    logged = make_trial(
        recording(half_sine(3), 100.0, metadata={"sensors": {"current_rectified": False}})
    ).reference
    assert np.array_equal(logged, held)
    with pytest.raises(HannesError, match="`reference_held` is 'yes'"):
        make_trial(recording(half_sine(3), 100.0, metadata={"reference_held": "yes"}))


def test_an_outlier_closure_is_left_out() -> None:
    trial = without_outliers(make_trial(recording(half_sine(8), 250.0, wobble=3)))
    assert len(trial.closures) == 7
    assert not any(abs(c.start - 12.0) < 0.5 for c in trial.closures)
    assert any("left out" in note for note in trial.notes)


@pytest.mark.parametrize(("number", "told"), ((0, True), (3, False)))
def test_a_first_closure_that_is_rather_far_from_the_others_stays_and_is_said(
    number: int, told: bool
) -> None:
    """One that is not the first differs by chance, for all that is known."""
    trial = make_trial(recording(half_sine(8), 250.0, wobble=number, by=0.07))
    looked_at = without_outliers(trial)
    assert looked_at.closures == trial.closures
    said = [note for note in looked_at.notes if note.startswith("the first closure is 3.")]
    assert len(said) == told, looked_at.notes
    assert without_outliers(make_trial(recording(half_sine(8), 250.0))).notes == ()


def test_no_closure_and_no_signal_are_clear_errors() -> None:
    with pytest.raises(HannesError, match="no closure was found"):
        make_trial(recording(np.zeros(4000), 250.0))
    only = Recording(
        {"encoder_position": Channel(np.arange(3.0), np.zeros(3), "rad", "encoder_position")}, {}, "x"
    )
    with pytest.raises(HannesError, match="reference_position"):
        make_trial(only)


def closed_every(period: float, said: dict[str, object]) -> Recording:
    """The reduced hand with a control loop of this period, logged without noise."""
    model = Model.load()
    controller = make_controller(model, period)
    run = rollout(make_plant(model), controller, half_sine(2, 10.0, 2.0, period), joints=False)
    names = {"reference_position": run.reference_position, "encoder_position": run.encoder_position}
    metadata = {"plant": "reduced", "object": "none", "sensors": {"current_rectified": False}, **said}
    return Recording({n: Channel(run.time, v, "rad", n) for n, v in names.items()}, metadata, "memory")


def test_the_control_period_is_what_the_recording_says() -> None:
    errors = []
    for said in ({"control_period": 0.004}, {}):
        prepared = prepare([make_trial(closed_every(0.004, said))], Model.load())
        errors.append(max(row.rmse for row in compare(prepared).errors))
    assert errors[0] < 2e-4 and errors[1] > 10.0 * errors[0], errors
    for wrong in (4.0, 0.0, True, "4 ms", float("nan")):
        with pytest.raises(HannesError, match=r"memory: its `control_period`.*in seconds"):
            make_trial(closed_every(0.004, {"control_period": wrong}))


def test_names_of_trials_are_made_unique() -> None:
    trial = make_trial(recording(half_sine(3), 250.0, metadata={"condition": "slow"}))
    names = [t.name for t in unique_names([trial, trial])]
    assert names == ["slow", "slow#2"]
    own = [replace(trial, name=name) for name in ("s", "s", "s#2", "s")]
    assert [t.name for t in unique_names(own)] == ["s", "s#3", "s#2", "s#4"]
    assert {t.conditions for t in unique_names(own)} == {("slow",)}, (
        "a condition of a name of its own keeps it"
    )
    (closure, *_), named = trial.closures, []
    for condition in ("s", "s.1", "slow"):
        closures = (replace(closure, condition=condition),)
        named.append(unique_names([replace(trial, name="s", closures=closures)] * 2)[1].conditions)
    assert named == [("s#2",), ("s#2.1",), ("slow",)]


def test_grouping_ignores_small_differences_only() -> None:
    reference = np.concatenate([half_sine(2), 1.01 * half_sine(1), 0.7 * half_sine(1)])
    spans = find_closures(reference, 1e-3)
    kinds = {c.condition for c in group_closures(reference, 1e-3, spans, "c")}
    assert len(spans) == 4 and len(kinds) == 2


@pytest.mark.parametrize("order", [(0, 1, 2, 3, 4, 5), (4, 2, 0, 5, 1, 3), (5, 4, 3, 2, 1, 0)])
def test_an_operators_amplitudes_are_one_condition_whichever_came_first(order: tuple[int, ...]) -> None:
    """Within 3 % of the one in their midst; a ramp of another amplitude, and one that was broken off, are no part."""
    amplitudes = np.array([0.972, 0.99, 1.0, 1.005, 1.027, 0.93])
    reference = np.concatenate([a * half_sine(1) for a in amplitudes[list(order)]])
    closures = group_closures(reference, 1e-3, find_closures(reference, 1e-3), "c")
    other = order.index(5)
    assert [k for k, c in enumerate(closures) if c.condition != closures[other - 1].condition] == [other]

    spans = find_closures(reference, 1e-3)
    start, stop = spans[order.index(1)]
    spans[order.index(1)] = start, start + 0.5 * (stop - start)
    left = group_closures(reference, 1e-3, spans, "c")
    assert len(left) == 5 and len({c.condition for c in left}) == 2, (
        "one that was broken off is no part, and no kind"
    )


@pytest.mark.parametrize(("units", "unit"), [({}, "rad"), ({"reference": "V"}, "V")])
def test_the_unit_of_the_reference_is_what_the_trial_says(units: dict[str, str], unit: str) -> None:
    trial = replace(make_trial(recording(half_sine(3), 250.0)), units=units)
    assert next(s["unit"] for s in told(trial)["signals"] if s["name"] == "reference") == unit


def test_where_an_operators_amplitudes_part_does_not_depend_on_their_order() -> None:
    """Two are in the midst of as many: the one that these are more like counts."""
    amplitudes = np.array([1.0, 1.02, 1.04, 1.061])
    found = set()
    for order in itertools.permutations(range(4)):
        reference = np.concatenate([a * half_sine(1) for a in amplitudes[list(order)]])
        closures = group_closures(reference, 1e-3, find_closures(reference, 1e-3), "c")
        kinds = {c.condition: [] for c in closures}
        for k, closure in enumerate(closures):
            kinds[closure.condition].append(order[k])
        found.add(frozenset(frozenset(own) for own in kinds.values()))
    assert found == {frozenset({frozenset({0, 1, 2}), frozenset({3})})}


def test_of_many_closures_a_few_are_asked() -> None:
    """As the middle of a condition: a hundred of two kinds are told apart, each with its scatter."""
    rng = np.random.default_rng(3)
    amplitudes = np.where(np.arange(100) % 3 == 0, 0.8, 1.0) * (1.0 + 0.008 * rng.standard_normal(100))
    reference = np.concatenate([a * half_sine(1) for a in amplitudes])
    closures = group_closures(reference, 1e-3, find_closures(reference, 1e-3), "c")
    assert [c.condition for c in closures] == ["c.1" if k % 3 == 0 else "c.2" for k in range(100)]


def soft_moves(seconds: float, rest: float, count: int = 5) -> np.ndarray:
    """Minimum-jerk moves to 1 and back, each after a rest, from one of 0.5 s on."""
    u = np.linspace(0.0, 1.0, round(1e3 * seconds))
    rise = 10.0 * u**3 - 15.0 * u**4 + 6.0 * u**5
    still = np.zeros(round(1e3 * rest))
    closure = np.concatenate([still, rise, np.ones(300), 1.0 - rise])
    return np.concatenate([np.zeros(500), np.tile(closure, count), still])


def test_a_closure_ends_before_the_next_one_leaves_its_rest() -> None:
    """A soft start is seen late: in all closures but the last the next one's would be the end of it."""
    for where in (0.0, 0.4):
        reference = where + 5.0 * soft_moves(1.0, 0.7)
        spans = find_closures(reference, 1e-3)
        assert len(spans) == 5
        for start, stop in spans:
            ends = reference[[round(1e3 * start), min(round(1e3 * stop), reference.size - 1)]]
            assert ends == pytest.approx(where, abs=5e-3)
        assert [start for start, _ in spans] == pytest.approx([1.2 + 3.0 * k for k in range(5)], abs=0.05)


@pytest.mark.parametrize("noise", [2e-4, 1e-3])
@pytest.mark.parametrize(("seconds", "rest"), [(0.5, 0.1), (0.5, 2.0), (1.0, 0.7), (3.0, 0.3), (3.0, 2.0)])
def test_noise_of_the_reference_makes_no_further_closures_or_conditions(
    seconds: float, rest: float, noise: float
) -> None:
    """While it leaves its rest slowly, it crosses any limit many times."""
    clean = soft_moves(seconds, rest)
    reference = 10.0 * (clean + noise * np.random.default_rng(1).standard_normal(clean.size))
    spans = find_closures(reference, 1e-3)
    closures = group_closures(reference, 1e-3, spans, "soft")
    assert len(closures) == 5 and {c.condition for c in closures} == {"soft"}
    every = 2.0 * seconds + 0.3 + rest
    assert np.diff([start for start, _ in spans]) == pytest.approx(every, abs=0.015)


def test_a_reference_that_stands_is_at_rest_only_where_others_are_lowest_too() -> None:
    """A step at the first value: the move is held, not at rest; so is a recording that is nothing else."""
    stood = np.concatenate([np.full(500, 2.0), np.full(500, 5.0)])
    at = np.arange(10) * 0.04
    for reference, spans, expected in (
        (stood, ((0.0, 0.45), (0.55, 0.95)), ("rest", "hold")),
        (np.full(1000, 2.7), ((0.0, 0.9),), ("hold",)),
    ):
        closures = tuple(Closure(a, b, str(k)) for k, (a, b) in enumerate(spans))
        signals = {"encoder_position": (np.arange(1000) * 1e-3, reference)}
        trial = Trial("x", 1e-3, reference, signals, closures)
        for closure, name in zip(closures, expected, strict=True):
            found = phase_of(trial, closure, at[at < closure.stop - closure.start - 0.05], None)
            assert set(found) == {PHASES.index(name)}


@pytest.mark.parametrize("lost", [0.0, 0.03, 0.15, 0.4])
def test_lost_messages_are_counted(lost: float) -> None:
    """By chance; not those of a logger that asks at a rate of its own, nor irregular stamps."""
    rng = np.random.default_rng(2)
    time = np.arange(3000) / 100.0 + rng.normal(0.0, 2e-4, 3000)
    heard = rng.random(time.size) >= lost
    part = lost_part(time[heard])
    assert part == (0.0 if lost < 0.1 else pytest.approx(lost, abs=0.03))
    assert lost_part(np.concatenate([time[heard], time[heard] + 90.0])) == pytest.approx(part, abs=0.01)
    asked = np.unique(np.floor(np.arange(0.0, 30.0, 1.0 / 66.7) * 100.0) / 100.0)
    whole_ms = np.unique(np.round(np.sort(np.arange(3000) / 500.0 + rng.normal(0.0, 7e-4, 3000)), 3))
    bursts = (np.arange(300)[:, None] * 0.02 + [0.0, 2e-4, 4e-4]).ravel()
    turns = np.floor(12.0 * np.sin(np.pi * np.arange(0.0, 12.0, 0.002) / 4.0) ** 2 / 0.05)
    changed = 0.002 * np.flatnonzero(np.diff(turns, prepend=-1.0))
    for none_lost in (
        asked,
        np.sort(rng.uniform(0.0, 30.0, 3000)),
        whole_ms,
        bursts,
        changed,
        time[:2],
        time[:0],
    ):
        assert lost_part(none_lost) == 0.0
    assert lost_part(np.repeat(time[heard], 2)) == pytest.approx(part, abs=0.01), "equal stamps"
