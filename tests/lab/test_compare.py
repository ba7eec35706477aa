"""In which phases a comparison puts what was recorded."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hannes_bags.recording import Channel, Recording
from hannes_control.reference import half_sine
from hannes_description.model import Model
from hannes_description.signals import SIGNALS
from hannes_lab.compare import compare
from hannes_lab.depends import Dependence, _dependences, _oscillation, pointed_at, residual_dependences
from hannes_lab.features import Features
from hannes_lab.hand import make_controller
from hannes_lab.hide import make_set
from hannes_lab.prepare import prepare
from hannes_lab.recorded import make_trial
from hannes_lab.trials import Trial
from hannes_sim.effect import strength_of
from hannes_sim.factory import make_plant
from hannes_sim.measurement import SENSORS
from hannes_sim.objects import named_object
from hannes_sim.rollout import rollout


@pytest.fixture(scope="module")
def empty() -> Trial:
    recordings, _ = make_set(Model.load(), [], seed=5, closures=5, conditions=("fast",))
    return make_trial(recordings[0])


@pytest.mark.parametrize("presses", [False, True])
def test_there_is_contact_where_the_dynamometer_shows_more_than_it_does_at_rest(
    empty: Trial, presses: bool
) -> None:
    """It reads 2 N at rest, in steps of 0.1 N, and is noisy; on nothing there is no greatest grip force either."""
    time, position = empty.signals["encoder_position"]
    force = 2.0 + 0.03 * np.random.default_rng(3).standard_normal(time.size)
    if presses:
        force = force + 2.0 * np.maximum(position - 8.0, 0.0)
    force = (time, np.round(force, 1))
    found = compare(prepare([replace(empty, signals={**empty.signals, "grip_force": force})], Model.load()))
    phases = {cell.phase for cell in found.cells}
    assert {"void", "opening"} <= phases and ("grasp" in phases) == presses
    assert any(row.name == "maximum_grip_force" for row in found.metrics) == presses
    (shown,) = (o for o in found.overlays if o.signal == "encoder_position")
    touched = np.asarray(shown.measured)[np.asarray(shown.phase) == "grasp"]
    assert not presses or touched.min() == pytest.approx(8.6, abs=0.7)


@pytest.mark.parametrize("periods", [(4.0, 4.0, 4.0, 2.0, 2.0, 2.0), (4.0, 2.0, 4.0, 2.0, 4.0, 2.0)])
def test_each_condition_of_a_recording_grasps_where_its_own_closures_do(periods: tuple[float, ...]) -> None:
    """Without a dynamometer the model tells when there is contact: in conditions one after the other, or in turn."""
    model, rng = Model.load(), np.random.default_rng(7)
    controller, sensors = make_controller(model, 1e-3), SENSORS["bench"]
    closures = [half_sine(1, 13.0, period, controller.period) for period in periods]
    reference = np.concatenate([np.zeros(500), *closures])
    run = rollout(make_plant(model, named_object("rigid")), controller, reference, joints=False)
    channels = {
        name: Channel(time, values, SIGNALS[name].unit, name)
        for name, (time, values) in sensors.sample(run, rng).items()
        if name != "grip_force"
    }
    described = {"object": "rigid", "sensors": sensors.to_dict()}
    found = compare(prepare([make_trial(Recording(channels, described, "rigid"))], model))
    shown = [o for o in found.overlays if o.signal == "encoder_position"]
    assert len(shown) == 2
    begins = 0.5 + np.cumsum((0.0, *periods[:-1]))
    for overlay, period in zip(shown, (4.0, 2.0), strict=True):
        begin = begins[[k for k, p in enumerate(periods) if p == period][1]]
        closing = (run.time > begin) & (run.time < begin + 0.5 * period)
        touches = run.time[closing & (run.grip_force > 0.05 * run.grip_force.max())][0] - begin
        phases = np.array(overlay.phase)
        grasps = np.asarray(overlay.time)[phases == "grasp"]
        assert grasps[0] == pytest.approx(touches, abs=0.08)


def test_without_position_current_and_force_there_are_no_figures_of_the_thesis() -> None:
    recordings, _ = make_set(Model.load(), [], seed=5, closures=3, conditions=("fast",), sensors="bench")
    prepared = prepare([make_trial(recordings[0])], Model.load(), signals=["motor_voltage"])
    found = compare(prepared)
    assert found.metrics == () and {cell.signal for cell in found.cells} == {"motor_voltage"}


def test_an_offset_depends_on_nothing_and_without_an_encoder_place_and_speed_are_unknown(
    empty: Trial,
) -> None:
    model = Model.load()
    prepared = prepare([empty], model)
    features, predicted = prepared.features, prepared.features.closures(prepared.rig, model, {})

    def shares(
        error: Callable[[np.ndarray], np.ndarray], features: Features, *signals: str
    ) -> dict[str, float]:
        """Shares for closures that differ from the model by an error as a function of the predicted signal."""
        chosen = [(b, c) for b, c in zip(features.blocks, predicted, strict=True) if b.signal in signals]
        blocks = tuple(replace(b, measured=c + error(c)) for b, c in chosen)
        found = residual_dependences(
            replace(features, blocks=blocks, slices=()), [c for _, c in chosen], prepared.rig.drive_signals
        )
        return {d.variable: d.share for d in found}

    def variables(shares: dict[str, float]) -> set[str]:
        return set(shares) - {"frequency", "friction_by_position", "inertia_by_position"}

    both = ("encoder_position", "motor_current")
    assert max(shares(lambda c: np.full_like(c, 0.2), features, *both).values()) < 1e-6
    of_load = shares(lambda c: 0.1 * c**2, features, *both)
    assert max(of_load, key=lambda name: of_load[name]) == "load" and of_load["load"] > 0.5
    assert variables(of_load) == {"position", "velocity", "direction", "load", "time"}
    assert variables(shares(lambda c: 0.1 * c**2, features, "motor_current")) == {"load", "time"}
    without = shares(lambda c: 0.1 * c**2, features, "encoder_position")
    assert variables(without) == {"position", "velocity", "direction", "time"}, "no signal tells the load"


def test_of_a_machine_that_goes_one_way_only_nothing_depends_on_the_direction() -> None:
    moves = np.concatenate([np.zeros(100), np.full(100, 0.3), np.zeros(100), np.full(100, -0.3)])

    def variables(velocity: np.ndarray) -> set[str]:
        states = {"velocity": [velocity[None]], "direction": [velocity[None]]}
        error = np.where(velocity != 0.0, 0.1, 0.0)
        found = _dependences({"motor_current": [error[None]]}, states, "motor_current", [0.01])
        return {d.variable for d in found}

    assert "direction" in variables(moves) and "direction" not in variables(moves[:300])


def test_what_brakes_at_a_place_both_ways_is_told_though_its_mean_there_is_nothing() -> None:
    """A belt that rubs where it is spliced: along the position alone there is nothing to see."""
    there = np.linspace(0.0, 1.0, 200)
    position = np.concatenate([there, there[::-1]])
    velocity = np.concatenate([np.full(200, 0.3), np.full(200, -0.3)])
    rubs = 0.2 * np.sign(velocity) * np.exp(-(((position - 0.6) / 0.08) ** 2))
    states = {"position": [position[None]], "velocity": [velocity[None]], "direction": [velocity[None]]}
    shares = {
        d.variable: d for d in _dependences({"drive_force": [rubs[None]]}, states, "drive_force", [0.01])
    }
    assert shares["friction_by_position"].share > 0.7 and shares["position"].share < 0.05
    curve = shares["friction_by_position"]
    assert curve.centres[int(np.argmax(curve.curve))] == pytest.approx(0.6, abs=0.08)
    assert max(curve.curve) > 0.12 and "friction by position (0." in curve.said
    assert "either way, most at 0." in pointed_at([curve], ["drive_force"])
    assert pointed_at([replace(curve, at=curve.centres[0])], ["drive_force"]) == "", "there it turns"


@pytest.mark.parametrize(("slope", "words"), [(0.3, "the more the larger"), (-0.3, "the less the larger")])
def test_what_brakes_the_more_the_farther_it_is_is_told_as_that(slope: float, words: str) -> None:
    """A wire that climbs its drum: the curve is farthest from its mean where it turns, and acts all the way."""
    there = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 300))
    position = np.concatenate([there, there[::-1]])
    velocity = np.gradient(position)
    climbs = np.sign(velocity) * slope * (position - 0.5)
    states = {"position": [position[None]], "velocity": [velocity[None]], "direction": [velocity[None]]}
    found = _dependences({"motor_current": [climbs[None]]}, states, "motor_current", [0.01])
    said = pointed_at(found, ["motor_current"])
    assert words in said and "along the way" in said
    # where no force is recorded it is the position that falls behind what brakes it
    lag = _dependences({"encoder_position": [-climbs[None]]}, states, "encoder_position", [0.01])
    assert pointed_at(lag, ["motor_current"]) == said.replace("motor_current", "encoder_position")


def test_what_swings_at_one_frequency_whatever_the_speed_is_told_from_a_ripple_along_the_way() -> None:
    rng = np.random.default_rng(4)
    steps, sizes = (0.01, 0.02, 0.04), (150, 150, 140)

    def closures(wave: Callable[[np.ndarray, float], np.ndarray]) -> list[np.ndarray]:
        """Of three conditions, the second half as fast as the first, the third a quarter."""
        return [
            wave(np.arange(n) * step, step / 0.01) + 0.05 * rng.normal(size=(6, n))
            for step, n in zip(steps, sizes, strict=True)
        ]

    def swing(t: np.ndarray, _: float) -> np.ndarray:
        since = t % (0.5 * t[-1])
        return np.exp(-2.0 * since) * np.sin(2.0 * np.pi * 5.7 * since)

    swinging = closures(swing)
    along = closures(lambda t, slower: np.sin(2.0 * np.pi * 9.0 * t / slower))
    noise = closures(lambda t, _: 0.0 * t)
    (swung,) = _oscillation("motor_current", swinging, steps)
    assert swung.share > 0.5 and swung.at == pytest.approx(5.7, rel=0.06)
    assert swung.centres[int(np.argmax(swung.curve))] == pytest.approx(5.7, rel=0.15)
    assert "oscillates at 5." in pointed_at([swung], ["motor_current"]) and swung.to_dict()["at"] == swung.at
    (rippled,) = _oscillation("motor_current", along, steps)
    assert rippled.share < 0.05 and pointed_at([rippled], ["motor_current"]) == ""
    assert all(d.share < 0.2 for d in _oscillation("motor_current", noise, steps))
    assert _oscillation("motor_current", [c[:, :10] for c in swinging], steps) == []
    assert _oscillation("motor_current", swinging[:1], steps[:1]) == [], "one speed cannot tell"
    alike = [swinging[0], swinging[0]]
    assert _oscillation("motor_current", alike, steps[:1] * 2) == [], (
        "nor do closures of one length, whatever they do"
    )
    (told,) = _oscillation("motor_current", alike, steps[:1] * 2, speeds=(1.0, 2.0))
    assert told.at == pytest.approx(swung.at, rel=0.1), "where their speeds are known, other speeds do"
    assert _oscillation("motor_current", swinging, steps, speeds=(1.0,) * len(steps)) == []


def test_what_a_fit_took_where_is_said() -> None:
    recordings, _ = make_set(
        Model.load(), [strength_of("glove_stiffness", 1.0)], seed=5, closures=5, conditions=("fast",)
    )
    prepared = prepare([make_trial(recordings[0])], Model.load())
    assert compare(prepared).values == {}
    found = compare(prepared, fitted=True)
    (note,) = (note for note in found.notes if note.startswith("the fit has "))
    value = found.values["hand.stiffness"]
    assert value > 0.002 and f"hand.stiffness {value:.3g} N.m/rad instead of 0.0015 (" in note
    assert found.to_dict()["values"] == found.values


def test_what_goes_with_a_place_that_is_passed_once_is_told_last() -> None:
    """An error that grows along the way of an open loop goes with the place, too."""
    once = Dependence("position", "encoder_position", 0.75, (), (), "rad", -27.0, 0.0)
    alike = Dependence("position", "encoder_position", 0.75, (), (), "rad", 1.0, 0.5)
    speed = Dependence("velocity", "encoder_position", 0.6, (), ())
    assert sorted([once, speed, alike], key=lambda d: -d.telling) == [alike, speed, once]
    assert once.said == "position (-27 rad) 75 % (0 % alike in all passes)"
