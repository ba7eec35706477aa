"""Options that several of the lab's commands take."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from joblib import cpu_count

from .limits import MAX_EFFECTS, MAX_GREEDY
from .trials import SIGNALS as COMPARED

Bags = Annotated[list[Path], typer.Argument(help="Bags, or folders of bags; one bag may hold many closures.")]
ModelFile = Annotated[
    str | None,
    typer.Option(
        "--model",
        help="Model file, or the name of a shipped model; default: nominal (nominal_mujoco of "
        "recordings of the full hand in the simulator), with --rig the model of the adapter.",
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]
Effects = Annotated[
    list[str] | None, typer.Option("--effect", help="Effect by name, or your own as path.py:Class.")
]
Objects = Annotated[
    list[str] | None,
    typer.Option(
        "--object", help="What a condition holds, as CONDITION=none|soft|rigid; overrides the bag's metadata."
    ),
]
Scale = Annotated[
    list[str] | None,
    typer.Option(
        "--scale",
        help="Factor of a signal to SI (rad at the pulley, A, V, N), as SIGNAL=FACTOR; 1 where the guess is wrong.",
    ),
]
Topics = Annotated[
    list[str] | None,
    typer.Option(
        "--topic",
        help="Topic that carries a signal, as SIGNAL=TOPIC, where the name does not say it; SIGNAL= leaves it out. "
        f"Signals: {', '.join(('reference_position', *COMPARED))}.",
    ),
]
LeaveOut = Annotated[
    list[str] | None,
    typer.Option(
        "--leave-out",
        help="Closures that do not count, as CONDITION=NUMBER[,NUMBER...], from 1 on, of those that `hannes trials "
        "--json` lists with their starts.",
    ),
]
RigFile = Annotated[
    str | None,
    typer.Option(
        "--rig",
        help="Another machine's adapter, as path.py:Class; BAGS are then the files, or the "
        "folder, that it reads.",
    ),
]
MaxEffects = Annotated[
    int | None,
    typer.Option(
        "--max-effects",
        min=1,
        help=f"Most effects that a diagnosis may name (default: {MAX_EFFECTS}; with --greedy {MAX_GREEDY}).",
    ),
]
Greedy = Annotated[
    bool | None,
    typer.Option(
        "--greedy/--no-greedy",
        help="Add effects one after another while the error on held-out conditions falls by 8 %, many small effects "
        "of a real machine, or look for the smallest set that explains all. Default: --greedy for recordings of a "
        "machine that no model has the form of (a --rig) in two conditions or more.",
    ),
]
Signals = Annotated[list[str] | None, typer.Option("--signal", help="Compare only these signals.")]
Jobs = Annotated[int, typer.Option("--jobs", min=1, help="Worker processes.")]
Dask = Annotated[
    str | None,
    typer.Option(
        "--dask", help="Work on the Dask cluster whose scheduler is at this address (tcp://HOST:8786)."
    ),
]
NoCache = Annotated[
    bool,
    typer.Option("--no-cache", help="Neither go on from the results that an earlier run kept, nor keep any."),
]
REPORT = "a self-contained HTML report, or one picture where the name ends in .png, .svg or .pdf"
ReportFile = Annotated[Path | None, typer.Option("--report", help=f"Write {REPORT}.")]

JOBS = max(1, cpu_count())
"""Cores that this process may use: fewer than the machine has in a container or a batch job."""
