"""Whether signals of a recording that nobody described are by clocks of their own: then they are moved, and said.

Drivers and computers hold signals back, each another time.  A few ms hide in what a model may be off; 30 ms bend a fit,
and what is read off the signals before it, until a hidden effect is not found any more.  But delays that are free where
all signals are in time lead searches astray too, so there are none unless the fitted nominal model comes much nearer.
"""

from __future__ import annotations

from dataclasses import replace

from .hand import SIGNAL_DELAY, HandRig, is_described
from .lags import moved_back
from .prepare import Prepared, prepare
from .search import Search

MUCH, EACH = 0.8, 9.0
"""Part of the fitted nominal model's cost that delays must leave at most, and the least that each must take of it."""

LEAST = 0.005
"""s from which a signal is moved."""


def in_time(prepared: Prepared, search: Search) -> tuple[Prepared, Search]:
    """The same, or where delays of single signals are needed, with these moved back; what is left of them is fitted.

    Only a hand's recordings may be by several clocks; a search through a surrogate is left as it is.
    """
    rig, signals = prepared.rig, list(dict.fromkeys(block.signal for block in prepared.features.blocks))
    if type(rig) is not HandRig or search.slow:
        return prepared, search
    anchor, delays = rig.delays(signals)
    if not delays:
        return prepared, search

    def needed(without: float, with_them: float) -> bool:
        return with_them <= min(MUCH * without, without - EACH * len(delays))

    found = search.with_nuisances([*search.nuisances, *delays]).null().fit
    if not needed(search.null().fit.cost, found.cost):
        return prepared, search
    # The fit without them may only have ended in a worse valley.
    start = {c.name: found.point[c.name] for c in search.coordinates}
    again = search.once(Search.begun_at, start, text="nominal: fit without delays")
    late = {delay.name.removeprefix(SIGNAL_DELAY): found.values[delay.name] for delay in delays}
    late = {name: seconds for name, seconds in late.items() if abs(seconds) >= LEAST}
    if not (late and needed(again.cost, found.cost)):
        return prepared, search
    what = "the encoder" if anchor == "encoder_position" else anchor
    trials = [
        trial if is_described(trial) else one
        for trial, one in zip(
            prepared.features.trials,
            moved_back(prepared.features.trials, late, f"{what} and the fitted nominal model say"),
            strict=True,
        )
    ]
    new = prepare(trials, prepared.model, signals=signals, typical=True)
    notes = tuple(dict.fromkeys((*prepared.notes, *new.notes)))
    return replace(new, notes=notes), search.on(new.problem, new.nuisances)
