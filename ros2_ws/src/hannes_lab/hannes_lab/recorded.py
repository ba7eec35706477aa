"""A trial from a recording: what is compared of it, on one clock, with what it says of itself."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from hannes_bags.recording import Recording
from hannes_description.errors import HannesError
from numpy.typing import NDArray

from .closures import SAME_KIND, find_closures, group_closures
from .described import control_period, hold_rate
from .gaps import guessed, has_gap, said_of_gaps, said_of_losses, split_gaps, widest_gap, without_guessed
from .reference import RESTS, reference_on_grid, rest_value
from .trials import EARLY, SIGNALS, NoClosure, Trial, in_words, left_out, stem_of
from .units import in_si

Array = NDArray[np.float64]

_NEGATIVE = 0.005
"""Part of the samples below nought, beyond noise, that a rectified current does not have."""

HOLDS = 0.5
"""s for which the last value of a reference holds at least, where its source ended."""

CUT = 0.1
"""s at the end of a recording of which it is said that they are left out."""

OR_ELSE = "(if that is wrong: `hannes describe BAG --say reference_held=true`, or false)"


def make_trial(
    recording: Recording,
    *,
    name: str | None = None,
    signals: Sequence[str] = SIGNALS,
    scale: Mapping[str, float] | None = None,
) -> Trial:
    """A trial from a recording; the condition's name and options come from its metadata where it has them.

    scale   factors to SI by signal name, where the recording is in other units
    Raises HannesError where the recording has no reference or none of the signals.
    """
    (converted,) = in_si([compared(recording, signals)], scale or {})
    return trial_of(converted, name=name)


def compared(recording: Recording, signals: Sequence[str] = SIGNALS) -> Recording:
    """The recording with nothing but its reference and what is compared of it."""
    if "reference_position" not in recording:
        raise HannesError(
            f"{recording.source} has no reference_position: it is needed, for the model replays it. "
            + recording.elsewhere()
        )
    present = [s for s in signals if s in recording.channels]
    if "motor_current" not in present and "motor_effort" in recording.channels:
        present.append("motor_effort")
    if not present:
        raise HannesError(
            f"{recording.source}: none of the signals {', '.join(signals)} is recorded; nothing can be "
            f"compared. {recording.elsewhere()}"
        )
    return replace(recording, channels={s: recording[s] for s in ("reference_position", *present)})


def trial_of(recording: Recording, *, name: str | None = None) -> Trial:
    """The trial of a recording in SI with nothing but what is compared."""
    notes = list(recording.warnings)
    meta = recording.metadata
    period = control_period(meta, recording.source)
    name = name or str(meta.get("condition") or stem_of(recording.source))
    channel = recording["reference_position"]
    _check_overlap(recording)
    origin = float(channel.time[0])
    origin = math.floor(origin / period + 1e-6) * period
    samples = {
        s: (np.asarray(c.time) - origin, np.asarray(c.values, dtype=float))
        for s, c in recording.channels.items()
    }
    logged = samples.pop("reference_position")
    whole_length = recording.end - origin
    duration = min(whole_length, _known_until(*logged))
    if whole_length - duration > CUT:
        notes.append(
            f"the reference ends {whole_length - duration:.1f} s before the recording does, away from its rest: what "
            "comes after is left out"
        )
    reference, note = reference_on_grid(*logged, period, duration, hold_rate(meta, recording.source))
    if note:
        notes.append(note if "reference_held" in meta else f"{note} {OR_ELSE}")
    begin = max(float(t[0]) for t, _ in samples.values())
    end = min(float(t[-1]) for t, _ in samples.values())
    spans = find_closures(reference, period)
    inside = [(a, min(b, end)) for a, b in spans if a >= begin - EARLY and min(b, end) > a]
    silent, alone = split_gaps(logged[0], samples)
    encoder = samples.get("encoder_position")
    notes += said_of_gaps(silent, guessed(alone, logged, encoder))
    times = {"reference_position": logged[0], **{s: time for s, (time, _) in samples.items()}}
    notes += said_of_losses(times)
    # A closure that seems to begin where the silence ends began in it.
    whole = [
        span
        for span in without_guessed(inside, alone, logged, encoder)
        if not any(has_gap(time, *span) for time, _ in samples.values())
        and not any(a < span[0] <= b for a, b in silent)
    ]
    if inside and not whole:
        raise NoClosure(f"Trial '{name}': samples are missing in each of its closures{widest_gap(times)}.")
    if len(whole) < len(inside):
        notes.append(left_out(len(inside) - len(whole)))
    closures = group_closures(reference, period, whole, name, channel.period)
    cut = len(spans) - len(closures) - (len(inside) - len(whole))
    if cut:
        notes.append(f"{cut} of {in_words(len(spans))} {'is' if cut == 1 else 'are'} cut off and left out")
    kinds = Counter(closure.condition for closure in closures)
    if len(kinds) > 1:
        told = ", ".join(f"{kind} ({in_words(count)})" for kind, count in kinds.items())
        notes.append(
            f"the references of its closures differ by more than {100 * SAME_KIND:.0f} % of their span, so they are "
            f"{len(kinds)} conditions: {told} (another amplitude, hold or rest, or one that was broken off); --object "
            "NAME=soft says what was grasped in one of them"
        )
    options = {key: meta[key] for key in ("object", "sensors", "plant") if key in meta}
    if "sensors" in options and "motor_current" in samples:
        options["sensors"], said = _as_it_is(options["sensors"], samples["motor_current"][1])
        notes += said
    return Trial(
        name,
        period,
        reference,
        samples,
        tuple(closures),
        options,
        recording.source,
        recording.sha256,
        tuple(notes),
    )


def _known_until(time: Array, values: Array) -> float:
    """Until when [s] a reference (n,) is known that was logged at these times (n,).

    Its last value holds on.  Where it is away from rest its source has ended in the midst of a closure, and where it
    stood then is no rest: it holds for as long as one did before, or HOLDS.
    """
    near = RESTS * float(np.ptp(values))
    if min(abs(values[-1] - rest) for rest in (values[0], rest_value(values))) <= near:
        return math.inf
    return float(time[-1]) + max(HOLDS, float(np.diff(time).max(initial=0.0)))


def _as_it_is(sensors: Any, current: Array) -> tuple[Any, list[str]]:
    """What a recording says of its loggers, less that a current is rectified which goes below nought."""
    if not (isinstance(sensors, Mapping) and sensors.get("current_rectified")):
        return sensors, []
    noise = sensors.get("current_noise", 0.0)
    least = 0.02 * float(np.ptp(current)) + 5.0 * (noise if isinstance(noise, int | float) else 0.0)
    if np.mean(current < -least) < _NEGATIVE:
        return sensors, []
    return {**sensors, "current_rectified": False}, [
        f"motor_current goes to {current.min():.3g} A, though the recording's `sensors` say that it is rectified: "
        'taken as signed; write "current_rectified": false there (`hannes describe`)'
    ]


def _check_overlap(recording: Recording) -> None:
    """Refuse a signal that was recorded at another time than the reference: nothing of it can be compared."""
    reference = recording["reference_position"].time
    for name, channel in recording.channels.items():
        if channel.time[0] > reference[-1] or channel.time[-1] < reference[0]:
            raise NoClosure(
                f"{recording.source}: {name} was recorded from {channel.time[0]:.1f} to {channel.time[-1]:.1f} s, but "
                f"reference_position from {reference[0]:.1f} to {reference[-1]:.1f} s: they do not overlap in time. "
                f"Record them together and by one clock, or leave the signal out with --topic {name}=."
            )
