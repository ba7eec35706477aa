"""A user's own effect file is tried in a process of its own before the lab works with it.

Compiled code that never returns cannot be interrupted, and one NaN spoils a fit without a word.  So the file is
imported, compiled and simulated once with its typical values where a time limit can end it.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterable, Sequence
from multiprocessing.connection import Connection

import numpy as np
from hannes_description.errors import HannesError
from hannes_sim.effect import ContributeFailed, EffectType, compile_effect, is_own_effect, load_effect
from hannes_sim.ports import DT, N_INPUTS, N_OUTPUTS, QL, RESISTANCE, SUPPLY, VL, Q, T, V
from numpy.typing import NDArray

from .trials import Trial

Array = NDArray[np.float64]

TIME_LIMIT = 60.0
"""s; import and compilation take a few, a closure milliseconds (on the MuJoCo plant a few seconds)."""

Simulate = Callable[[str], object]


def check_own_effects(
    sources: Iterable[str], simulate: Simulate, motion: tuple[Array, Array], *, limit: float = TIME_LIMIT
) -> None:
    """Try every source that is a file (path.py:Class); names of the catalogue are passed over.

    simulate  loads the effect and runs a closure with it; raises HannesError
    motion    time (n,) s and position (n,) of a closure: where the effect must give numbers
    Raises one HannesError that says what is wrong with the effect.
    """
    for source in sources:
        if is_own_effect(source):
            _check(source, simulate, motion, limit)


def first_closure(trials: Sequence[Trial]) -> tuple[Trial, Array]:
    """The trial whose first closure ends soonest, and its reference up to there."""
    trial = min(trials, key=lambda t: t.closures[0].stop)
    return trial, trial.reference[: round(trial.closures[0].stop / trial.period)]


def along_reference(trial: Trial, reference: Array) -> tuple[Array, Array]:
    """Time (n,) s and position (n,) of a closure that follows its reference."""
    ticks = np.arange(0, reference.size, max(1, reference.size // 400))
    return np.asarray(ticks * trial.period), reference[ticks]


def _check(source: str, simulate: Simulate, motion: tuple[Array, Array], limit: float) -> None:
    said = apart(
        lambda: _try(source, simulate, motion),
        ended=f"'{source}' ended the process that tried it: its contribute(x, p, s, y) writes outside its arrays.",
        endless=f"'{source}' did not finish one closure within {limit:.0f} s: the file or its contribute(x, p, s, y) "
        "has a loop that does not end.",
        limit=limit,
    )
    if said:
        raise HannesError(said)


def apart(work: Callable[[], str], *, ended: str, endless: str, limit: float) -> str:
    """What `work` says in a process of its own: `ended` if that ends, `endless` if it takes longer than `limit` s.

    What `work` refuses with a HannesError is what it says.
    """
    context = multiprocessing.get_context("fork")
    here, there = context.Pipe(duplex=False)
    process = context.Process(target=_answer, args=(work, there), daemon=True)
    process.start()
    there.close()
    try:
        return str(here.recv()) if here.poll(limit) else endless
    except EOFError:
        return ended
    finally:
        if process.is_alive():
            process.join(1.0)
        if process.is_alive():
            process.kill()
        process.join()
        here.close()


def _answer(work: Callable[[], str], there: Connection) -> None:
    # What ends the parent ends this by its hand; the parent says so.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    try:
        said = work()
    except HannesError as error:
        said = str(error)
    there.send(said)
    there.close()


def _try(source: str, simulate: Simulate, motion: tuple[Array, Array]) -> str:
    kind = load_effect(source)
    compile_effect(kind)  # type: ignore[arg-type]  # a class is hashable
    with np.errstate(all="ignore"):
        said = _without_number(kind, source, *motion)
    if not said:
        try:
            simulate(source)
        except HannesError as error:
            strong = "" if isinstance(error, ContributeFailed) else " Is the typical value too strong?"
            said = f"'{source}' with its typical values: {error}{strong}"
    return said


def _acts_switched_off(kind: EffectType, x: Array) -> bool:
    off = np.array([p.typical if p.vanishing is None else p.vanishing for p in kind.figures()])
    y = np.zeros(N_OUTPUTS)
    kind.contribute(x, off, np.zeros(kind.states), y)
    return bool(np.any(np.abs(y) > 1e-12))


def _without_number(kind: EffectType, source: str, time: Array, position: Array) -> str:
    """A sentence if contribute gives NaN, infinity or an error along a motion; "" if it gives numbers.

    Compiled, a NaN may vanish in a limiter and the effect would silently do nothing.
    """
    x, s, y = np.zeros(N_INPUTS), np.zeros(kind.states), np.zeros(N_OUTPUTS)
    x[RESISTANCE] = x[SUPPLY] = 1.0  # which no machine has at 0
    p = np.array([parameter.typical for parameter in kind.figures()])
    velocity = np.gradient(position, time)
    x[DT] = float(np.median(np.diff(time)))
    for t, q, v in zip(time, position, velocity, strict=True):
        x[T], x[Q], x[QL], x[V], x[VL] = t, q, q, v, v
        y[:] = 0.0
        given, twin, more = (x.copy(), p.copy()), s.copy(), np.ones(N_OUTPUTS)
        try:
            kind.contribute(x, p, s, y)
            kind.contribute(x, p, twin, more)
            wrong = "" if np.isfinite(y).all() and np.isfinite(s).all() else "NaN or infinity"
        except IndexError as error:
            wrong = f"no number ({error}; s has as many as its class says: `states = 1`)"
        except (ArithmeticError, ValueError) as error:
            wrong = f"no number ({error})"
        if not wrong and kind.parameters and _acts_switched_off(kind, x):
            return (
                f"'{source}': with its parameters at their vanishing values it still acts, at position {q:.4g}, "
                f"velocity {v:.4g}. An effect that is switched off must add nothing."
            )
        if not (np.array_equal(given[0], x) and np.array_equal(given[1], p)):
            return f"'{source}': contribute(x, p, s, y) changes x or p; it may only read them."
        if not wrong and not np.allclose(more - 1.0, y, rtol=1e-6, atol=1e-9):
            return (
                f"'{source}': contribute(x, p, s, y) sets an output at position {q:.4g}, velocity {v:.4g}; it must add "
                "to y (`y[TORQUE] += ...`), where other effects add too."
            )
        if wrong:
            return (
                f"'{source}': contribute(x, p, s, y) gives {wrong} at position {q:.4g}, velocity {v:.4g} with its "
                "typical parameters. It must give finite numbers wherever the machine moves."
            )
    return ""
