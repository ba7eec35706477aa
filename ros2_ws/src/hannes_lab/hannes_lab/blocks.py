"""Conditions one after the other in one recording: told apart, and each made a recording of its own."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from .reference import RESTS
from .trials import Closure, Trial, curves_of, in_words

BLOCK_REST = 0.3
"""s for which the hand rests before a block of closures that is taken as a recording of its own."""

JUMP = 6.0
"""Change of a signal from one closure to the next, over the usual one, from which another condition may begin there
though the reference is the same: something else is grasped."""

SEEN = 0.05
"""Part of the signal's span in the closure with less of it that the change must be, too: a firm grasp makes the span
of all so large that a soft one after nothing is little beside it."""

CLOSE = 3.0
"""The two closures before it, and the two after it, differ by this factor less."""


def told_apart(trial: Trial) -> Trial:
    """Conditions with the same reference have names of their own where the hand does something else from a closure on.

    A recording that describes nothing may hold closures on nothing and then some on an object.  A closure that is an
    outlier, or what changes little by little, makes no condition.
    """
    if "sensors" in trial.options:
        return trial
    blocks = [block for name in trial.conditions for block in _alike(trial, trial.of(name))]
    if len(blocks) == len(trial.conditions):
        return trial
    blocks.sort(key=lambda block: block[0].start)
    named = [[replace(c, condition=f"{trial.name}.{k}") for c in block] for k, block in enumerate(blocks, 1)]
    told = ", ".join(
        f"{b[0].condition} ({in_words(len(b))} from {max(b[0].start, 0.0):.1f} s)" for b in named
    )
    note = (
        f"the reference is the same, but the hand does something else from a closure on, so they are {len(blocks)} "
        f"conditions: {told}; --object NAME=soft says what was grasped in one of them"
    )
    closures = sorted((c for block in named for c in block), key=lambda c: c.start)
    return replace(trial, closures=tuple(closures), notes=(*trial.notes, note))


def _alike(trial: Trial, closures: Sequence[Closure]) -> list[Sequence[Closure]]:
    """Closures of one condition, split where what the hand does changes at once and stays so."""
    n = len(closures)
    if n < 4:
        return [closures]
    jumps: set[int] = set()
    for time, values in trial.signals.values():
        curves = curves_of(closures, time, values)
        away = np.sqrt(((curves[:, None] - curves[None]) ** 2).mean(axis=2))
        usual = float(np.median(np.diagonal(away, 1)))
        spans = np.ptp(curves, axis=1)
        jumps |= {
            k
            for k in range(2, n - 1)
            if away[k - 1, k] > max(JUMP * usual, SEEN * spans[k - 1 : k + 1].min())
            and away[k - 2 : k, k : k + 2].min() > CLOSE * max(away[k - 2, k - 1], away[k, k + 1])
        }
    cuts = [0, *sorted(jumps), n]
    return [closures[a:b] for a, b in itertools.pairwise(cuts)]


def in_blocks(trial: Trial) -> list[Trial]:
    """One recording for each condition where a recording that describes nothing holds several, one after the other.

    Each may have its own object then, and is simulated by itself.  The recording stays whole where a condition has one
    closure or comes again later, or where the hand does not rest before a block.
    """
    order = [condition for condition, _ in itertools.groupby(c.condition for c in trial.closures)]
    if len(order) < 2 or len(order) != len(trial.conditions) or "sensors" in trial.options:
        return [trial]
    blocks = [trial.of(condition) for condition in order]
    rests = [_rest_before(trial, block[0]) for block in blocks]
    if min(map(len, blocks)) < 2 or min(rests[1:]) < BLOCK_REST:
        return [trial]
    begins = [
        0,
        *(
            round((b[0].start - 0.5 * min(r, 1.0)) / trial.period)
            for b, r in zip(blocks[1:], rests[1:], strict=True)
        ),
    ]
    # The last closure of a block ends where the next block's first one sets off, which is after that one's rest.
    ends = [*(round(b[0].start / trial.period) for b in blocks[1:]), trial.reference.size]
    parts: list[Trial] = []
    for block, begin, end in zip(blocks, begins, ends, strict=True):
        origin, stop = begin * trial.period, end * trial.period
        inside = {name: (time >= origin) & (time < stop) for name, (time, _) in trial.signals.items()}
        parts.append(
            replace(
                trial,
                name=block[0].condition,
                reference=trial.reference[begin:end],
                signals={n: (t[inside[n]] - origin, v[inside[n]]) for n, (t, v) in trial.signals.items()},
                closures=tuple(replace(c, start=c.start - origin, stop=c.stop - origin) for c in block),
                notes=trial.notes if not parts else (),
            )
        )
    return parts


def _rest_before(trial: Trial, closure: Closure) -> float:
    """s for which the reference stands before a closure begins."""
    at = round(closure.start / trial.period)
    moves = np.flatnonzero(
        np.abs(trial.reference[: at + 1] - trial.reference[max(at, 0)]) > RESTS * trial.span
    )
    return (at - (int(moves[-1]) if moves.size else 0)) * trial.period
