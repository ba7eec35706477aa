"""The process behind the lab's web page: one comparison, diagnosis or addition, told as lines of JSON.

`python -m hannes_lab.page_worker FOLDER` reads FOLDER/task.json, writes what there is to download into FOLDER, and says
on its standard output how far it is.  It lives as long as its standard input stays open: closed, it ends as by Ctrl-C,
and what it has found stays in the store, from which the next run of the page or of the command line goes on.
"""

from __future__ import annotations

import json
import os
import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from hannes_description.errors import HannesError
from hannes_description.output import finite
from hannes_sim.effect import catalogue

from .add import Addition, add_effects
from .compare import compare
from .diagnose import diagnose, effect_sources
from .diagnosis import Diagnosis
from .features import data_used
from .provenance import save_model
from .report import verdict_of, write_report
from .session import after, before, executor_of, prepared_from, try_effects

Say = Callable[[Mapping[str, Any]], None]

REPORT, ANSWER, MODEL = "report.html", "answer.json", "my_hand.yaml"
"""Files that a task leaves in its folder; the model only if effects were found or added."""

GRACE_S = 5.0
"""Seconds that a process has to end by itself once it is told to."""

EVERY_S = 0.1
"""Seconds between two lines of progress of the same text."""

FIT = {
    "model": "model",
    "rig": "rig",
    "objects": "object",
    "scale": "scale",
    "topics": "topic",
    "leave_out": "leave-out",
    "signals": "signal",
}
"""What is asked of every command, and its option on the command line."""


def main(folder: Path) -> int:
    """Carry out the task of a folder; exit codes are those of the `hannes` command."""
    # not closed before the process ends, so that its end is the end of the lines
    out = os.fdopen(os.dup(1), "w", encoding="utf-8", closefd=False)
    os.dup2(2, 1)  # what a library prints belongs on the terminal, not between the lines of JSON
    # a shell that starts the page in its background makes all below it deaf to the signal that ends a task
    signal.signal(signal.SIGINT, signal.default_int_handler)
    threading.Thread(target=_end_when_left, daemon=True).start()

    def say(message: Mapping[str, Any]) -> None:
        print(json.dumps(finite(message)), file=out, flush=True)

    try:
        work(json.loads((folder / "task.json").read_text(encoding="utf-8")), folder, say)
    except HannesError as error:
        say({"kind": "error", "text": str(error)})
        return 2
    except KeyboardInterrupt:
        return 130
    return 0


def _end_when_left() -> None:
    """Wait until nobody holds the other end of the standard input, then end this process and its own."""
    while os.read(0, 1):
        pass
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(GRACE_S)
    os.killpg(os.getpgrp(), signal.SIGKILL)


class _Progress:
    """Progress as lines, a few in a second."""

    def __init__(self, say: Say) -> None:
        self._say = say
        self._text = ""
        self._next = 0.0

    def __call__(self, done: int, total: int, text: str) -> None:
        now = time.monotonic()
        if text != self._text or done >= total or now >= self._next:
            self._text, self._next = text, now + EVERY_S
            self._say({"kind": "progress", "done": done, "total": total, "text": text})


def work(task: Mapping[str, Any], folder: Path, say: Say) -> None:
    """Do what `hannes compare`, `diagnose` or `add` do with --report, and say what the page shows beside the report.

    task  action (read, compare, diagnose, add), bags, the options of the command by their Python names, jobs
    say   is called with messages of the kinds effects, data, progress and done
    """
    action, wanted = task["action"], task.get("effects") or []
    progress = _Progress(say)
    say({"kind": "effects", "titles": {name: kind.title for name, kind in catalogue().items()}})
    progress(0, 1, "reading the bags")
    prepared = prepared_from(task["bags"], threads=task["jobs"], **{name: task.get(name) for name in FIT})
    progress(1, 1, "reading the bags")
    notes = list(prepared.notes)
    say({"kind": "data", "data": data_used(prepared.features), "notes": notes, "model": prepared.model.name})
    if action == "read":
        return
    found: Diagnosis | Addition | None = None
    if action != "compare":
        try_effects(prepared, wanted)
        with executor_of(task["jobs"]) as executor:
            found = _find(task, prepared, executor, progress)
    comparison = finite((before(prepared, found) if found else compare(prepared)).to_dict())
    answer = finite(found.to_dict()) if found else comparison
    shown: dict[str, Any] = {
        "comparison": comparison,
        "after": finite(after(prepared, found).to_dict()) if found else None,
        "diagnosis": answer if found else None,
    }
    command = command_line(task)
    files = [REPORT, ANSWER]
    write_report(folder / REPORT, **shown, title="Hannes: model against measurement", command=command)
    (folder / ANSWER).write_text(json.dumps(answer, indent=2), encoding="utf-8")
    if found and found.effects:
        save_model(found.model, folder / MODEL, command)
        files.append(MODEL)
    verdict = verdict_of(**shown)
    effects = [e.source or e.name for e in found.effects] if found else []
    words = {name: verdict[name] for name in ("kind", "label", "headline", "summary")}
    say(
        {
            "kind": "done",
            "action": action,
            "verdict": words,
            "effects": effects,
            "files": files,
            "command": command,
        }
    )


def _find(task: Mapping[str, Any], prepared: Any, executor: Any, progress: _Progress) -> Diagnosis | Addition:
    wanted, model = task.get("effects") or [], prepared.model
    if task["action"] == "add":
        sources = effect_sources(only=wanted, model=model)
        return add_effects(prepared, sources, executor=executor, progress=progress)
    only = wanted if task.get("only") else None
    return diagnose(
        prepared,
        effect_sources(() if only else wanted, only=only, model=model),
        executor=executor,
        progress=progress,
        max_effects=task["max_effects"],
        greedy=task["greedy"],
    )


def command_line(task: Mapping[str, Any]) -> str:
    """The command that gives the same answer in a shell."""
    action = task["action"]
    words = ["hannes", action, *map(str, task["bags"])]
    for name, option in FIT.items():
        given = task.get(name) or ()
        for value in [given] if isinstance(given, str) else given:
            words += [f"--{option}", value]
    for effect in task.get("effects") or () if action != "compare" else ():
        words += ["--only" if task.get("only") and action == "diagnose" else "--effect", effect]
    if action == "diagnose":
        if task["greedy"] is not None:
            words += ["--greedy" if task["greedy"] else "--no-greedy"]
        if task["max_effects"] is not None:
            words += ["--max-effects", str(task["max_effects"])]
        words += ["--add"]
    return shlex.join([*words, "--report", REPORT])


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
