"""The hand as a rig: plants and controller of a model file, sensors and objects of a trial."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from hannes_control.double_pid import DoublePID, DoublePIDParameters
from hannes_description.model import Model
from hannes_description.parameters import data_path, read_yaml
from hannes_sim.factory import is_plant, make_plant
from hannes_sim.measurement import folded_mean, goes_below_nought, logger, sample_noise
from hannes_sim.objects import GraspObject
from hannes_sim.plant import Plant
from hannes_sim.rollout import Rollout, step_of
from numpy.typing import NDArray

from .clock import REFERENCE_DELAY, REFERENCE_DELAY_SD, later, moved, moving_mean
from .described import grasp_of, loggers_of
from .features import FINEST, Block
from .rig import Nuisance, PlantRig, make_controller
from .trials import SAME, Trial

__all__ = ["HandRig", "make_controller", "object_of", "sensors_of"]

Array = NDArray[np.float64]

_PLACE = "object.position"
_PER_OBJECT = ("object.stiffness", _PLACE)
_OBJECT_UNITS = {"object.stiffness": "N.m/rad", _PLACE: "rad", "object.damping": "N.m.s/rad"}
"""Of the whole grasp, as the pulley feels it."""

_UNKNOWN_OBJECT_SD = {"object.stiffness": 1.5, _PLACE: 2.0}
_UNKNOWN_DAMPING_SD = 1.5
"""Widths of the priors of an object of which only the kind is known (of the logarithm, of the place in rad)."""

_UNKNOWN_GAINS = {
    "control.kp": 0.2,
    "control.damping": 0.5,
    "control.ki": 0.5,
    "control.current_kp": 1.2,
    "control.current_ki": 1.2,
}
"""Gains of a controller that nobody described, with the widths of their priors (of the logarithm): the outer loop shows
in the static error; of the inner one the thesis gives the order of magnitude.  One that is 0 stays so."""

_GAINS = frozenset(f"control.{field.name}" for field in fields(DoublePIDParameters))

INTEGRAL_SEEN = 0.6
"""An outer loop has an integral if that leaves less than this part of what is left without."""

IN_COMMON = 0.2
"""An outer loop shows where current and position error have this in common at least: of hands whose gains are known
they had 0.88 and more, and 0.07 where fast closures alone, rectified at 30 Hz, gave fourteen times the gain."""

_UNKNOWN_ZERO_SD = 0.1
"""rad; what a hand calls open whose homing nobody described."""

_ZERO = "encoder.zero"
HAND_ZERO = "encoder.hand_zero"
"""The part of the encoder's zero that described recordings of one hand share; each has its own beside it, as the hand
may have been homed anew.  Without it the tolerance would be charged once per recording."""

LOWEST = "encoder.lowest"
"""The motor of a hand that nobody described unwinds no farther than its encoder ever showed: some pulleys stop where
the hand is open, others run on along a slack wire."""

HOMING = "encoder.homing"
_UNKNOWN_HOMING_SD = 1.0
"""rad; how far the wire is wound up, and the hand off its open stop, where an encoder reads zero whose homing nobody
described.  The place of an object is what the encoder shows there: that is seen, whatever the homing."""

WINDING = 0.6
"""s in which the motor winds the wire up before the first closure."""

_WIRE = "wire.stiffness"
_UNKNOWN_WIRE_SD = 0.5
"""Width of its prior (of the logarithm): nobody measured it, and on an unknown object it counts with the object's."""

_DRY_FRICTION = ("friction.coulomb", "hand.coulomb")
LESS_FRICTION = 0.35
"""Of the nominal value: standard deviation of a dry friction that is less, in a hand that is not this simulator's.  The
nominal one is what the data sheet's current without load gives; the thesis' figures are met with half of it (0.018 N.m
in all, thesis section 4), and none at all is within three of these.  Upwards the tolerance stays: more friction than
that is an effect."""

_ROTOR = "motor.armature"
_UNKNOWN_ROTOR_SD = 0.02
"""Width of its prior (of the logarithm).  It tells a current sensor's gain error from a hand that is heavier in all."""

_APART = 4.0
"""Standard deviations from the mean over the recordings: one hand whose open position, or clock, is elsewhere in each
recording is no explanation, however well it fits."""

CURRENT_WINDOW = "log.current_window"
VOLTAGE_WINDOW = "log.voltage_window"
"""Over which a logger that nobody described averages, s: the current about half of its sampling, the voltage, which
many log as it was commanded last, from nothing to about one sampling."""

SIGNAL_DELAY = "log.delay_of_"
"""Beginning of the name of how much later a signal is than the others, s: one that was by another clock and moved to
theirs, or one of a recording that nobody described, where the encoder's delay is that of the reference."""

MOVED = "moved"
"""Option of a trial: the names of those signals."""

OWN_ERROR: Mapping[str, float] = {"encoder_position": 0.0022}
OWN_ERROR_DRIVE = 0.015
"""Of a signal's span: how far the form of the model may be from that of a hand that is not this simulator's.  The loop
holds the position; what the model does not know shows in what drives it."""

OWN_ERROR_ELECTRIC = 0.0022
"""Of its span: how far a voltage beside current and position may be from R i + k w."""

COARSE = 1e-3
"""Of a signal's span: what the closures of a hand without noise are taken to scatter.  With the true parameters they
are missed by up to a tenth of that; taken for known so well, a fit of the full hand does not find its way to them."""

OWN_ERROR_LENGTH = 0.1
"""Part of a closure over which that stays alike."""

RESTING = 0.05
AT_REST = 10.0
"""How many times larger that is while reference or encoder is within this part of the reference's span of its rest: the
hand lies against its open stop on a slack wire, of which nothing is known."""

REFERENCE_LEAD = "log.reference_lead"
LEAD_SEEN = 0.02
"""s; a reference that seems so early is one whose rate the controller sees too (a derivative of the error)."""

_SMOOTHED = 0.03
"""s; a reference that comes by messages has a rate only over one or several of them."""


def object_of(trial: Trial) -> GraspObject | None:
    """What a trial's metadata says was grasped."""
    return grasp_of(trial.options, f"Trial '{trial.name}'")


def sensors_of(trial: Trial) -> dict[str, Any]:
    """How the current was logged: from the metadata, else guessed from the data (rectified if never below nought)."""
    if (sensors := loggers_of(trial.options, f"Trial '{trial.name}'")) is not None:
        return {
            "rectified": sensors.current_rectified,
            "window": sensors.current_window,
            "noise": sensors.current_noise,
        }
    if "motor_current" not in trial.signals:
        return {"rectified": False, "window": 0.0, "noise": 0.0}
    values = trial.signals["motor_current"][1]
    return {
        "rectified": not goes_below_nought(values),
        "window": 0.0,
        "noise": sample_noise(values),
    }


def tells_logging(trial: Trial) -> bool:
    """True where the recording says how it was logged."""
    return trial.options.get("sensors") is not None


def is_described(trial: Trial) -> bool:
    """True where the recording says how it was logged, and that it was made by a plant of this project in its loop.

    Then clocks, gains, homing and the named object are what they say.  Of any other recording (a real hand's, another
    simulator's) these are unknown, and fitted with wide priors.
    """
    return tells_logging(trial) and is_plant(str(trial.options.get("plant", "")))


def is_of(trial: Trial, model: Model) -> bool:
    """True where the recording says that it was made by the plant of the model.

    To any other machine the model is an approximation: it has an error of its own, and parameters that stand for more
    than one thing (an object's place and stiffness as the pulley feels them, the wire's stiffness) are not known.
    """
    return is_described(trial) and trial.options.get("plant") == model.plant


NOMINAL = "nominal"
"""The model that recordings are compared with where nothing says another."""

MODEL_OF = {"reduced": NOMINAL, "mujoco": "nominal_mujoco"}
"""The plant that a recording names, and the model that has it."""


def model_of(trials: Sequence[Trial]) -> str:
    """The shipped model that has the plant which made all recordings, as they say; `nominal` where they do not."""
    made = {str(trial.options["plant"]) if is_described(trial) else "" for trial in trials}
    return MODEL_OF.get(made.pop(), NOMINAL) if len(made) == 1 else NOMINAL


def other_plant(trials: Sequence[Trial], model: Model) -> list[str]:
    """A sentence where this project's other plant made the recordings: its parameters are not felt alike."""
    made = {str(trial.options["plant"]) for trial in trials if is_described(trial)}
    return [
        f"the recordings say that plant '{plant}' made them, and model '{model.name}' has '{model.plant}': the two are "
        "not of one form (the full hand's spring is felt softer at the pulley than the reduced hand's), so they are "
        f"treated as another machine's; --model {MODEL_OF[plant]} compares like with like"
        for plant in sorted(made & MODEL_OF.keys() - {model.plant})
    ]


BOUNCE = 0.1
"""s within which an encoder that bounced at the open stop of its hand is back where it rests."""
SETTLED = 0.2
"""s for which it then stays there at least."""
ALREADY_BACK = 0.1
"""Part of the bounce's depth that it may still be off then."""


def _lowest_kept(time: Array, reading: Array) -> float:
    """The lowest reading of (n,), rad; without a bounce at the open stop, where the hand is back at rest at once.

    What runs on along a slack wire is away for longer, and no bounce.
    """
    lowest = float(reading.min())
    early, late = (_lowest_for(time, reading, span) for span in (BOUNCE, SETTLED))
    return late if late - early <= ALREADY_BACK * (late - lowest) else lowest


def _lowest_for(time: Array, reading: Array, span: float) -> float:
    """The lowest reading that was not exceeded for so many s."""
    ends = np.searchsorted(time, time + span)
    begins = np.flatnonzero(ends < time.size)
    if not begins.size:
        return float(reading.min())
    pairs = np.column_stack([begins, ends[begins]]).ravel()
    return float(np.maximum.reduceat(reading, pairs)[::2].min())


@lru_cache(maxsize=64)
def _gains(settings: DoublePIDParameters, changed: tuple[tuple[str, float], ...]) -> Array:
    """The controller's numbers with some of them changed."""
    return replace(settings, **dict(changed)).to_array()


@lru_cache(maxsize=512)
def _divided(names: tuple[str, ...]) -> tuple[tuple[str, ...], tuple[tuple[str, str], ...]]:
    """Of the names of values those of the plant's parameters, and those of the controller's gains with the gain."""
    apart = (HAND_ZERO, HOMING)
    of_plant = tuple(n for n in names if not n.startswith(("control.", "log.")) and n not in apart)
    return of_plant, tuple((n, n.removeprefix("control.")) for n in names if n.startswith("control."))


class HandRig(PlantRig):
    """Simulates trials of the hand, on whichever plant the model names: objects, sensors and encoder zero per trial.

    Where a recording does not say how it was logged, the clock of its reference, the window of its current logger and
    the gains of its controller are nuisance parameters.
    """

    population = data_path("parameters", "population.yaml")
    phases: Mapping[str, str] = {}
    machine = "hand"
    figures = True
    foreign = False  # what does not describe itself has an error of the model's own
    same = SAME
    experiments = True

    def __init__(self, trials: Sequence[Trial]) -> None:
        super().__init__(trials)
        self._sensors = {trial.name: sensors_of(trial) for trial in self.trials}
        self._lowest = {
            trial.name: _lowest_kept(*trial.signals["encoder_position"])
            for trial in self.trials
            if "encoder_position" in trial.signals and not is_described(trial)
        }

    @property
    def finest(self) -> float:
        """See Rig."""
        return FINEST

    @property
    def coarse(self) -> float:
        """See Rig: the encoder is rounded in a hand, not in a fit."""
        return COARSE

    @classmethod
    def read(cls, paths: Sequence[Path]) -> list[Trial]:
        """Trials of all bags below the paths."""
        from .prepare import load_trials

        return load_trials(paths)

    def nuisances(self, model: Model) -> list[Nuisance]:
        """Priors from population.yaml; object parameters per trial with an object, the encoder's zero per trial.

        What the model's file and a recording's object say of their own tolerance goes before those.
        """
        out, other = [], self._of_others(model)
        for name, entry in read_yaml(Path(self.population), "population file").items():
            sd, scatter, relative = float(entry["hand_sd"]), float(entry["closure_sd"]), entry["unit"] == "1"
            if name in _PER_OBJECT:
                for trial in self.trials:
                    out += self._of_object(name, trial, model, sd, scatter, relative)
            elif name == _ZERO:
                if sum(map(is_described, self.trials)) > 1:
                    out.append(Nuisance(HAND_ZERO, 0.0, sd, False, unit="rad"))
                out += [
                    Nuisance(
                        f"{name}@{trial.name}",
                        0.0,
                        sd if is_described(trial) else _UNKNOWN_ZERO_SD,
                        False,
                        scatter,
                        "rad",
                        wide=not is_described(trial),
                        apart=math.inf if is_described(trial) else _APART,
                    )
                    for trial in self.trials
                ]
            elif model.parameters.value(name) > 0.0:
                own = self._nuisance(name, entry, model)
                less = other and name in _DRY_FRICTION
                out.append(replace(own, below=LESS_FRICTION * own.mean) if less else own)
        return self.as_told([*out, *(replace(n, wide=True) for n in self._bench_nuisances(model))], model)

    def is_gain(self, name: str) -> bool:
        """See PlantRig."""
        return name in _GAINS

    def _of_object(
        self, name: str, trial: Trial, model: Model, sd: float, scatter: float, relative: bool
    ) -> list[Nuisance]:
        """Priors of a parameter of a trial's object, if there is one; with its stiffness comes its damping.

        sd, scatter, relative   of an object of this project's plants, from hand to hand and from closure to closure
        """
        grasp = object_of(trial)
        if grasp is None:
            return []
        plant, _, _ = self._plant(model.without_effects(), trial)
        known = is_of(trial, model) and not trial.options.get("object_seen")
        if name == _PLACE:
            width, unit = sd if known else _UNKNOWN_OBJECT_SD[name], _OBJECT_UNITS[name]
            return [
                Nuisance(f"{name}@{trial.name}", plant.get(name), width, relative, scatter, unit, not known)
            ]
        if grasp.tolerance == 0.0:
            return []
        told, damping = grasp.tolerance, "object.damping"
        wide = not (known or told)
        width = told or (sd if known else _UNKNOWN_OBJECT_SD[name])
        stiffness, unit = plant.get(name), _OBJECT_UNITS[name]
        out = [Nuisance(f"{name}@{trial.name}", stiffness, width, relative, scatter, unit, wide)]
        if not known and damping in plant.names and plant.get(damping) > 0.0:
            width, unit = told or _UNKNOWN_DAMPING_SD, _OBJECT_UNITS[damping]
            own = Nuisance(f"{damping}@{trial.name}", plant.get(damping), width, True, 0.0, unit, wide)
            out.append(replace(own, effect="object_damping"))
        return out

    def _of_others(self, model: Model) -> list[Trial]:
        """Recordings of another machine than the model's."""
        return [trial for trial in self.trials if not is_of(trial, model)]

    def _bench_nuisances(self, model: Model) -> list[Nuisance]:
        """What is unknown of controller and logger where a recording does not describe them."""
        strange = [trial for trial in self.trials if not is_described(trial)]
        out: list[Nuisance] = []
        delay = lead = 0.0
        if strange and model.controller == "double_pid":
            means = {n: model.parameters.value(n) for n in _UNKNOWN_GAINS if n in model.parameters}
            seen = outer_loop(strange)
            if seen is not None:
                delay = seen.delay
                if delay < -LEAD_SEEN:
                    delay, lead = 0.0, -delay
                    out.append(Nuisance(REFERENCE_LEAD, lead, REFERENCE_DELAY_SD, False, unit="s"))
                means |= {"control.kp": seen.kp, "control.damping": seen.damping}
                if seen.ki > 0.0:
                    means["control.ki"] = seen.ki
            out += [
                Nuisance(name, means[name], sd, True, unit=model.parameters[name].unit)
                for name, sd in _UNKNOWN_GAINS.items()
                if means.get(name, 0.0) > 0.0
            ]
        other = self._of_others(model)
        known = self._plant(model.without_effects(), other[0])[0].names if other else ()
        out += [
            Nuisance(name, model.parameters.value(name), sd, True, unit=model.parameters[name].unit)
            for name, sd in ((_WIRE, _UNKNOWN_WIRE_SD), (_ROTOR, _UNKNOWN_ROTOR_SD))
            if name in known and model.parameters.value(name) > 0.0
        ]
        if strange:
            out.append(Nuisance(HOMING, 0.0, _UNKNOWN_HOMING_SD, False, unit="rad", lower=0.0))
        unlogged = [trial for trial in strange if not tells_logging(trial)]
        if (step := _sampling(unlogged, "motor_current")) is not None:
            out.append(Nuisance(CURRENT_WINDOW, 0.5 * step, 1.0, True, unit="s"))
        if (step := _sampling(strange, "motor_voltage")) is not None:
            out.append(Nuisance(VOLTAGE_WINDOW, 0.0, step, False, unit="s", lower=0.0))
        out += [
            Nuisance(f"{REFERENCE_DELAY}@{t.name}", delay, REFERENCE_DELAY_SD, False, unit="s", apart=_APART)
            for t in strange
        ]
        moved = dict.fromkeys(name for t in self.trials for name in t.options.get(MOVED, ()))
        out += [Nuisance(f"{SIGNAL_DELAY}{name}", 0.0, REFERENCE_DELAY_SD, False, unit="s") for name in moved]
        return out

    def delays(self, signals: Sequence[str]) -> tuple[str, list[Nuisance]]:
        """Delays of signals of recordings that nobody described, for where they are needed (delays.py).

        With them the signal against which they count, whose delay is the reference's: the encoder, or the first of
        `signals` without one.
        """
        strange = [trial for trial in self.trials if not is_described(trial)]
        there = [s for s in signals if any(s in t.signals for t in strange)]
        anchor = min(there, key=lambda s: s != "encoder_position", default="")
        moved = {name for t in self.trials for name in t.options.get(MOVED, ())}
        return anchor, [
            Nuisance(f"{SIGNAL_DELAY}{name}", 0.0, REFERENCE_DELAY_SD, False, unit="s")
            for name in there
            if name != anchor and name not in moved
        ]

    def own_error(self, blocks: Sequence[Block], model: Model) -> Array:
        """See Rig: none for a recording of this plant, as its description says.

        Else each signal strays by itself, but for a voltage beside current and position: R i + k w holds whatever the
        hand does, so it strays with the current, and by as much as a position may from one moment to the next.
        """
        sizes = [block.phase.size for block in blocks]
        out = np.zeros((sum(sizes),) * 2)
        if is_of(self.trials[blocks[0].trial], model):
            return out
        strays = [self._strays(block, model) for block in blocks]
        larger = np.concatenate([np.where(self._rests(block), AT_REST, 1.0) for block in blocks])
        ends = np.cumsum([0, *sizes])
        length = OWN_ERROR_LENGTH * float(np.ptp(blocks[0].phase))
        for k, m in itertools.product(range(len(blocks)), repeat=2):
            part = out[ends[k] : ends[k + 1], ends[m] : ends[m + 1]]
            alike = np.exp(-np.abs(blocks[k].phase[:, None] - blocks[m].phase) / length)
            # In one order, whatever the process: what is kept is found again by the sum's last digit.
            for source in (s for s in strays[k] if s in strays[m]):
                part += strays[k][source] @ alike @ strays[m][source].T
        return larger[:, None] * out * larger

    def _strays(self, block: Block, model: Model) -> dict[str, Array]:
        """How errors of standard deviation 1 make up that of a block: (p, p) by what strays."""
        trial, p, whole = self.trials[block.trial], model.parameters, np.eye(block.phase.size)
        if block.signal != "motor_voltage" or not {"motor_current", "encoder_position"} <= set(trial.signals):
            wide = OWN_ERROR.get(block.signal, OWN_ERROR_DRIVE) * _span(block.measured)
            if block.signal == "grip_force" and object_of(trial) is None:
                # All that it shows is its own: a zero that is known no better than its noise, or noise without what is
                # below nought.
                wide = math.hypot(wide, float(block.measured.std()))
            return {block.signal: wide * whole}
        rate = np.asarray(np.gradient(whole, block.phase, axis=0))
        volts = block.measured.mean(axis=0)
        amperes, angle = (
            _span(_during(trial, block.condition, name)) for name in ("motor_current", "encoder_position")
        )
        sign = np.sign(volts) if self._sensors[trial.name]["rectified"] else np.ones(volts.size)
        ohms, turns = p.value("motor.resistance"), p.value("motor.kt") * p.value("gear.ratio")
        return {
            "motor_current": ohms * OWN_ERROR_DRIVE * amperes * np.diag(sign),
            # The position's own error counts in the position already: here it counts half.
            "speed": math.sqrt(2.0) * turns * OWN_ERROR["encoder_position"] * angle * rate,
            "motor_voltage": OWN_ERROR_ELECTRIC * _span(volts) * whole,
        }

    def _rests(self, block: Block) -> NDArray[np.bool_]:
        """(p,) where reference or encoder is close to its rest."""
        trial = self.trials[block.trial]
        at = trial.of(block.condition)[0].start + block.phase
        near = RESTING * trial.span
        rest = float(np.median(trial.reference[[0, -1]]))
        ticks = np.arange(trial.reference.size) * trial.period
        resting = np.abs(np.interp(at, ticks, trial.reference) - rest) < near
        if "encoder_position" in trial.signals:
            resting |= np.abs(np.interp(at, *trial.signals["encoder_position"]) - rest) < near
        return resting

    def comes_back(self, model: Model, trial: Trial) -> float:
        """See PlantRig; of another machine the model's position is known no better than its own error says."""
        known = super().comes_back(model, trial)
        return known if is_of(trial, model) else max(known, OWN_ERROR["encoder_position"])

    def plant(self, model: Model, trial: Trial) -> Plant:
        """The plant with the trial's object, encoder quantiser off."""
        plant = make_plant(model, object_of(trial), dt=step_of(trial.period))
        if "encoder.resolution" in plant.names:
            plant.set("encoder.resolution", 0.0)
        return plant

    def run(self, model: Model, values: Mapping[str, float], trial: Trial, reference: Array) -> Rollout:
        """The rollout itself; gains of the controller and the clock of the reference may be among the values."""
        strange = not is_described(trial)
        names, gains = _divided(tuple(values))
        of_plant = {name: values[name] for name in names}
        delay = values.get(f"{REFERENCE_DELAY}@{trial.name}", 0.0)
        lead = values.get(REFERENCE_LEAD, 0.0) if strange else 0.0
        shift = 0.0 if strange else values.get(HAND_ZERO, 0.0)
        wound = values.get(HOMING, 0.0) if strange else 0.0
        before = None
        if wound and trial.closures[0].start < WINDING:
            before = np.full(round(WINDING / trial.period), reference[0])
        if shift or wound:
            zero, place = f"{_ZERO}@{trial.name}", f"{_PLACE}@{trial.name}"
            of_plant[zero] = of_plant.get(zero, 0.0) + shift - wound
            if place in of_plant:
                of_plant[place] += wound
        plant, controller, _ = self._plant(model, trial)
        if trial.name in self._lowest and LOWEST in plant.names:
            of_plant[LOWEST] = self._lowest[trial.name]
        if isinstance(controller, DoublePID):
            controller.parameters[:] = _gains(
                controller.settings, tuple((gain, values[name]) for name, gain in gains)
            )
        return self._run(model, of_plant, trial, moved(reference, delay, lead, trial), before)

    def observed(
        self, model: Model, values: Mapping[str, float], trial: Trial, reference: Array
    ) -> dict[str, Array]:
        """See PlantRig."""
        strange = not is_described(trial)
        window = None if tells_logging(trial) else values.get(CURRENT_WINDOW)
        signals = self.logged(self.run(model, values, trial, reference), trial, window)
        if strange and values.get(VOLTAGE_WINDOW):
            signals["motor_voltage"] = moving_mean(
                signals["motor_voltage"], 1.0 + values[VOLTAGE_WINDOW] / trial.period
            )
        for name in trial.signals if strange else trial.options.get(MOVED, ()):
            if delay := values.get(SIGNAL_DELAY + name, 0.0):
                signals[name] = later(signals[name], delay / trial.period)
        return signals

    def logged(self, run: Rollout, trial: Trial, window: float | None = None) -> dict[str, Array]:
        """Signals as the hand's loggers show them: the current filtered, and rectified where it was."""
        logged = self._sensors[trial.name]
        if window is None:
            current = logger(
                run.motor_current, trial.period, rectified=logged["rectified"], window=logged["window"]
            )
        else:
            current = moving_mean(
                np.abs(run.motor_current) if logged["rectified"] else run.motor_current, window / trial.period
            )
        if logged["rectified"]:
            current = folded_mean(current, logged["noise"])
        return {
            "encoder_position": run.encoder_position,
            "motor_current": current,
            "motor_voltage": run.motor_voltage,
            "grip_force": run.grip_force,
            "motor_effort": run.motor_effort,
        }


def _span(values: Array) -> float:
    return float(np.ptp(values)) or 1.0


def _during(trial: Trial, condition: str, signal: str) -> Array:
    """Values of a signal during the closures of a condition."""
    time, values = trial.signals[signal]
    closures = trial.of(condition)
    during: Array = values[(time >= closures[0].start) & (time <= closures[-1].stop)]
    return during


def _sampling(trials: Sequence[Trial], signal: str) -> float | None:
    """The time between two samples of a signal [s]; None if it was not recorded."""
    logged = next((t.signals[signal][0] for t in trials if signal in t.signals), None)
    return None if logged is None else float(np.median(np.diff(logged)))


class OuterLoop(NamedTuple):
    """Gain [A/rad], damping [A.s/rad], delay of the reference [s] and integral gain [A/(rad.s)] of the outer loop."""

    kp: float
    damping: float
    delay: float
    ki: float


def outer_loop(trials: Sequence[Trial]) -> OuterLoop | None:
    """The outer loop as the recordings show it.

    While the inner loop keeps up, i = kp (r - tau r' - q) + ki S - kd q', whatever the motor drives, with S the
    integral of r - q; so r - q is linear in i, q', r' and S, up to a constant for each closure (an encoder's zero, what
    S was before).  A negative tau is a controller that sees the reference's rate too (a derivative of the error).
    One law for all recordings, each counting as well as it follows such a law: in fast ones the voltage reaches its
    limit, and a logger of few hertz that averages and rectifies lags behind the current.
    None where the recordings do not show it.
    """
    tables = [table for table in map(_outer_rows, trials) if table is not None]
    if not tables:
        return None
    rows = np.concatenate([table / max(_linear_law(table)[1], 1e-12) for table in tables])
    (per_ampere, lag, delay), left = _linear_law(rows[:, [0, 1, 2, 4]])
    per_past, others = 0.0, [1, 2]
    integrating, with_integral = _linear_law(rows)
    if integrating[3] > 0.0 and with_integral < INTEGRAL_SEEN * left:
        per_ampere, lag, delay, per_past = integrating
        others = [1, 2, 3]
    if per_ampere <= 0.0 or lag <= 0.0 or abs(delay) > 0.2 or _in_common(rows, others) < IN_COMMON:
        return None
    return OuterLoop(*(float(x) for x in (1.0 / per_ampere, lag / per_ampere, delay, per_past / per_ampere)))


def _outer_rows(trial: Trial) -> Array | None:
    """(n, 5) i, q', r', -S and r - q of `outer_loop` where the hand moves, each less its mean over the closure."""
    if not {"motor_current", "encoder_position"} <= set(trial.signals):
        return None
    time, current = trial.signals["motor_current"]
    signed = goes_below_nought(current)
    ticks = np.arange(trial.reference.size) * trial.period
    width = max(1, round(_SMOOTHED / trial.period))
    reference = np.convolve(trial.reference, np.ones(width) / width, mode="same")
    rate = np.gradient(reference, trial.period)
    past = np.cumsum(reference - np.interp(ticks, *trial.signals["encoder_position"])) * trial.period
    step = float(np.median(np.diff(time)))
    rows = []
    for closure in trial.closures:
        at = np.arange(closure.start, closure.stop, step)
        if at.size < 8:
            continue
        position = np.interp(at, *trial.signals["encoder_position"])
        velocity = np.gradient(position, at)
        r, dr, s = (np.interp(at, ticks, values) for values in (reference, rate, past))
        moving = (np.abs(velocity) if signed else velocity) > 0.1 * velocity.max()
        if moving.any():
            own = np.column_stack([np.interp(at, time, current), velocity, dr, -s, r - position])[moving]
            rows.append(own - own.mean(axis=0))
    table = np.concatenate(rows) if rows else np.zeros((0, 5))
    return table if table.shape[0] >= 30 else None


def _in_common(rows: Array, others: Sequence[int]) -> float:
    """Correlation of the current and r - q of `outer_loop`, less what other columns explain of either."""
    known = rows[:, others]
    own = [x - known @ np.linalg.lstsq(known, x, rcond=None)[0] for x in (rows[:, 0], rows[:, 4])]
    both = float(np.linalg.norm(own[0]) * np.linalg.norm(own[1]))
    return float(own[0] @ own[1]) / both if both > 0.0 else 0.0


def _linear_law(rows: Array) -> tuple[Array, float]:
    """Least-squares solution (k,) of rows (n, k + 1), the last column by the others, and the norm of what is left."""
    known, wanted = rows[:, :-1], rows[:, -1]
    solution, *_ = np.linalg.lstsq(known, wanted, rcond=None)
    return np.asarray(solution), float(np.linalg.norm(wanted - known @ solution))
