"""`hannes demo`: the whole way once, from EMG to a report that says which effect the model lacks."""

from __future__ import annotations

import shutil
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_description.output import print_json

from .options import JsonOption

if TYPE_CHECKING:
    from hannes_bags.recording import Recording

GRASPS = ("none", "soft", "rigid")
GRAPH_MODEL = "nominal_mujoco"
GRAPH_TIMEOUT = 90.0
"""s of wall time after which a graph run is given up."""


def demo(
    out: Annotated[Path, typer.Option(help="Folder for bags, pictures and the report; made anew.")] = Path(
        "demo_out"
    ),
    bags: Annotated[Path, typer.Option(help="Recorded closures to diagnose.")] = Path("bags/recorded_hand"),
    emg: Annotated[str, typer.Option(help="Two-channel EMG recording (.csv); empty for synthetic EMG.")] = "",
    seconds: Annotated[float, typer.Option(min=0.5, help="Simulated seconds of each graph run.")] = 4.0,
    jobs: Annotated[int, typer.Option(min=1, help="Worker processes of the diagnosis.")] = 2,
    json: JsonOption = False,
) -> None:
    """Run the node graph on nothing, a soft and a rigid object, then diagnose recorded closures of a hand.

    Every node is a process; the graph runs in lock-step and is recorded. The recorded closures that ship in bags/ hide
    an effect that the nominal model lacks: the lab compares, finds it, adds it, and shows the error fall.
    """
    began = time.monotonic()

    def say(text: str) -> None:
        print(f"[{time.monotonic() - began:5.1f} s] {text}", file=sys.stderr, flush=True)

    if not bags.exists():
        raise HannesError(
            f"No recorded closures at '{bags}': run `hannes demo` in the project's folder, or give --bags."
        )
    _fresh(out)
    graph = {grasp: _run_graph(grasp, out, emg, seconds, say) for grasp in GRASPS}
    picture = _picture(graph, out, say)
    result = _lab(bags, out, jobs, say) | {
        "picture": str(picture.resolve()),
        "seconds": time.monotonic() - began,
        "bags": {g: r.source for g, r in graph.items()},
    }
    if json:
        print_json(result)
        return
    typer.echo(f"\n{result['summary']}\n")
    typer.echo(f"model    {result['model']}")
    typer.echo(f"picture  {result['picture']}")
    typer.echo(f"report   {result['report']}")


def _fresh(out: Path) -> None:
    """An empty folder; only a folder that an earlier demo made is emptied."""
    marker = out / ".hannes_demo"
    if out.exists() and any(out.iterdir()):
        if not marker.exists():
            raise HannesError(f"'{out}' exists and was not made by the demo; give another folder with --out.")
        shutil.rmtree(out)
    out.mkdir(parents=True, exist_ok=True)
    marker.touch()


def _run_graph(grasp: str, out: Path, emg: str, seconds: float, say: Callable[[str], None]) -> Recording:
    """One closure through the node graph, each node a process; gives back what the bag holds."""
    bag, log = out / f"graph_{grasp}", out / f"graph_{grasp}.log"
    say(f"node graph in lock-step, object: {grasp} ({seconds:g} s simulated, plant: MuJoCo)")
    command = [
        sys.executable,
        "-m",
        "hannes_bringup.cli",
        "run",
        "graph",
        "--clock",
        "lockstep",
        "--object",
        grasp,
        "--model",
        GRAPH_MODEL,
        "--duration",
        str(seconds),
        "--record",
        str(bag),
        "--emg",
        emg,
    ]
    with open(log, "wb") as file:
        try:
            done = subprocess.run(
                command,
                stdout=file,
                stderr=subprocess.STDOUT,
                stdin=subprocess.DEVNULL,
                timeout=GRAPH_TIMEOUT,
                check=False,
            )
        except subprocess.TimeoutExpired:
            raise HannesError(
                f"The node graph did not finish within {GRAPH_TIMEOUT:g} s; see {log}."
            ) from None
    if done.returncode != 0:
        last = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        raise HannesError(
            f"The node graph ended with code {done.returncode}; see {log}. Last line: "
            f"{last[-1] if last else '(none)'}"
        )
    from hannes_bags.reading import read_and_say

    recording = read_and_say(bag, lambda text: say(f"  {text}"))
    recording.require(["motor_current", "encoder_position", "reference_position", "stiffness_label"])
    current = recording["motor_current"].values
    labels = Counter(str(label) for label in recording["stiffness_label"].values)
    force = recording["grip_force"].values.max() if "grip_force" in recording else float("nan")
    say(
        f"  recorded {sum(c.time.size for c in recording.channels.values())} samples; largest current "
        f"{current.max():.2f} A, grip force {force:.1f} N; classifier: "
        + ", ".join(f"{label} {100 * n / labels.total():.0f} %" for label, n in labels.most_common())
    )
    return recording


def _picture(graph: dict[str, Recording], out: Path, say: Callable[[str], None]) -> Path:
    """The hand at its tightest on each object, above what the graph recorded."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    import numpy as np

    colours = {"none": "#7a8798", "soft": "#2a9d8f", "rigid": "#d1495b"}
    images = _hand_images(graph, say)
    figure = plt.figure(figsize=(11, 9 if images else 5.5), layout="constrained")
    grid = figure.add_gridspec(2 if images else 1, 1, height_ratios=[1.15, 1] if images else [1])
    if images:
        top = grid[0].subgridspec(1, len(images), wspace=0.02)
        for k, (grasp, image) in enumerate(images.items()):
            axis = figure.add_subplot(top[k])
            axis.imshow(image)
            axis.set_axis_off()
            axis.set_title(
                {"none": "nothing", "soft": "soft ball", "rigid": "dynamometer"}[grasp],
                color=colours[grasp],
                fontweight="bold",
            )
    lower = grid[-1].subgridspec(1, 2)
    position, current = figure.add_subplot(lower[0]), figure.add_subplot(lower[1])
    for grasp, recording in graph.items():
        state, amps = recording["encoder_position"], recording["motor_current"]
        position.plot(
            state.time, state.values, color=colours[grasp], label={"none": "nothing"}.get(grasp, grasp)
        )
        current.plot(amps.time, amps.values, color=colours[grasp], lw=0.9)
    reference = graph["none"]["reference_position"]
    position.plot(
        reference.time, reference.values, color="black", lw=0.9, ls="--", label="reference from EMG"
    )
    position.set(xlabel="time / s", ylabel="encoder position / rad at the pulley")
    current.set(xlabel="time / s", ylabel="motor current / A")
    position.legend(frameon=False, fontsize=9)
    for axis in (position, current):
        axis.spines[["top", "right"]].set_visible(False)
        axis.set_xlim(0, max(float(np.max(r["encoder_position"].time)) for r in graph.values()))
    path = out / "closures.png"
    figure.savefig(path, dpi=110)
    plt.close(figure)
    say(f"picture of the closures: {path}")
    return path


def _hand_images(graph: dict[str, Recording], say: Callable[[str], None]) -> dict[str, Any]:
    """The hand where each recording is closed most; empty where there is no offscreen OpenGL."""
    import numpy as np
    from hannes_sim.objects import named_object
    from hannes_sim.render import HandRenderer

    model = Model.load(GRAPH_MODEL)
    images: dict[str, Any] = {}
    try:
        for grasp, recording in graph.items():
            if "joint_positions" not in recording:
                return {}
            joints = np.asarray(recording["joint_positions"].values, dtype=float)
            with HandRenderer(
                model.parameters, model.variant, named_object(grasp), width=700, height=640
            ) as renderer:
                images[grasp] = renderer.draw(joints[int(np.argmax(joints.sum(axis=1)))])
    except HannesError as error:
        say(f"  no pictures of the hand: {error}")
        return {}
    return images


def _lab(bags: Path, out: Path, jobs: int, say: Callable[[str], None]) -> dict[str, Any]:
    """Compare, diagnose, add, report."""
    from hannes_lab.compare import compare
    from hannes_lab.diagnose import diagnose, effect_sources
    from hannes_lab.prepare import load_trials, prepare
    from hannes_lab.provenance import save_model
    from hannes_lab.report import write_report
    from hannes_lab.session import after as compare_after

    trials = load_trials([bags])
    say(f"lab: {sum(len(t.closures) for t in trials)} recorded closures in {len(trials)} bags from {bags}")
    prepared = prepare(trials, Model.load("nominal"))
    before = compare(prepared)
    failing = sum(cell.fails for cell in before.cells)
    say(
        f"  compare: the nominal model misses by {before.overall:.1f} times the repeatability; "
        f"{failing} of {len(before.cells)} cells fail"
    )
    found = diagnose(
        prepared,
        effect_sources(model=prepared.model),
        jobs=jobs,
        progress=_throttled(lambda text: say(f"  diagnose: {text}")),
    )
    say(f"  verdict: {found.verdict}: {', '.join(e.name for e in found.effects) or '-'}")
    for fall in found.falls:
        say(f"    {fall.added:<24} held-out error {fall.held_out:6.2f} times the repeatability")
    command = f"hannes report {bags}"
    path = out / "my_hand.yaml"
    save_model(found.model, path, command)
    after = compare_after(prepared, found)
    report = write_report(
        out / "report.html",
        comparison=before.to_dict(),
        after=after.to_dict(),
        diagnosis=found.to_dict(),
        title="Hannes: model against a recorded hand",
        command=command,
    )
    return {
        "summary": found.summary,
        "verdict": found.verdict,
        "effects": [e.name for e in found.effects],
        "model": str(path.resolve()),
        "report": str(Path(report).resolve()),
    }


def _throttled(say: Callable[[str], None], every: float = 2.0) -> Callable[[int, int, str], None]:
    last = [0.0]

    def progress(done: int, total: int, text: str) -> None:
        if time.monotonic() - last[0] >= every:
            last[0] = time.monotonic()
            say(f"{text} {done}/{total}")

    return progress
