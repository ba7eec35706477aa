"""`hannes trials`: what the lab reads of recordings, before anything is simulated."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from hannes_description.output import (
    TEXT_WIDTH,
    between,
    number,
    print_json,
    show_table,
    text_console,
    with_unit,
)
from rich.table import Table

from .cli_options import Bags, Json, LeaveOut, Objects, RigFile, Scale, Topics

if TYPE_CHECKING:
    from .trials import Trial


def trials(
    bags: Bags,
    objects: Objects = None,
    scale: Scale = None,
    topics: Topics = None,
    leave_out: LeaveOut = None,
    rig: RigFile = None,
    json: Json = False,
) -> None:
    """Tell what the lab reads of recordings: conditions, closures, signals with rates, units and ranges.

    Nothing is simulated: a look at what an adapter, or a bag, gives before the first `compare`. The reference is the
    one that is replayed, a value for each control period, however it was logged. A closure lasts from where it leaves
    its rest to where it does again, the last one to the end of the recording.
    """
    from .prepare import as_compared, notes_of
    from .session import closures_named, trials_from

    machine, read_in = trials_from(bags, objects, rig, scale, topics)
    found = as_compared(read_in, machine, closures_named(leave_out))
    read = [told(trial) for trial in found]
    notes = notes_of(found)
    if json:
        print_json({"trials": read, "notes": notes})
    else:
        _show(read, notes)


def told(trial: Trial) -> dict[str, Any]:
    """A trial in numbers: times in s, a rate in Hz (the median of its samples), ranges in the signal's unit.

    A reference whose unit the trial does not say (`units`) is in that of the encoder, if one is recorded.
    """
    followed = trial.unit("encoder_position") if "encoder_position" in trial.signals else ""
    conditions = []
    for name in trial.conditions:
        own = trial.of(name)
        lengths = [c.stop - c.start for c in own]
        conditions.append(
            {
                "name": name,
                "closures": len(own),
                "shortest": min(lengths),
                "longest": max(lengths),
                "starts": [c.start for c in own],
            }
        )
    signals = [_signal("reference", trial.units.get("reference", followed), trial.reference, trial.period)]
    for name, (time, values) in trial.signals.items():
        step = float(np.median(np.diff(time))) if time.size > 1 else float("nan")
        signals.append(_signal(name, trial.unit(name), values, step))
    return {
        "name": trial.name,
        "recordings": [part.source or part.name for part in trial.parts] or [trial.source],
        "period": trial.period,
        "seconds": trial.reference.size * trial.period,
        "conditions": conditions,
        "signals": signals,
    }


def _signal(name: str, unit: str, values: Any, step: float) -> dict[str, Any]:
    lowest, highest = float(np.min(values)), float(np.max(values))
    rounding = 1e-12 * (highest - lowest)
    return {
        "name": name,
        "unit": unit,
        "samples": int(values.size),
        "rate": 1.0 / step if step > 0.0 else None,
        "lowest": lowest if abs(lowest) > rounding else 0.0,
        "highest": highest if abs(highest) > rounding else 0.0,
    }


def _show(read: Sequence[dict[str, Any]], notes: Sequence[str]) -> None:
    console = text_console()
    table = Table(title="Conditions")
    for name in ("trial", "recordings", "condition", "closures", "length, s", "control period"):
        table.add_column(name, justify="left" if name in ("trial", "condition") else "right")
    for one in read:
        for c in one["conditions"]:
            table.add_row(
                one["name"],
                str(len(one["recordings"])),
                c["name"],
                str(c["closures"]),
                between(c["shortest"], c["longest"]),
                with_unit(1e3 * one["period"], "ms"),
            )
    show_table(table, TEXT_WIDTH)
    table = Table(title="Signals")
    for name in ("trial", "signal", "samples", "rate, Hz", "lowest", "highest", "unit"):
        table.add_column(name, justify="left" if name in ("trial", "signal", "unit") else "right")
    for one in read:
        for s in one["signals"]:
            rate = "" if s["rate"] is None else number(s["rate"], 4)
            low, high = number(s["lowest"], 4), number(s["highest"], 4)
            name = "reference, replayed" if s["name"] == "reference" else s["name"]
            table.add_row(one["name"], name, str(s["samples"]), rate, low, high, s["unit"])
    show_table(table, TEXT_WIDTH)
    for note in notes:
        console.print(f"note: {note}", style="dim")
