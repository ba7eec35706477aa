"""The lab's web page: the answers of compare, diagnose and add, and how far the work is, in a browser.

The page computes nothing: a worker process (page_worker.py) does what the commands do, and what it found is shown as
the report of the command line.  Who may see it: page_guard.py.
"""

from __future__ import annotations

import asyncio
import html
import json
import os
import signal
import socket
import sys
import tempfile
import time
import webbrowser
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import typer
from hannes_description.errors import HannesError
from hannes_description.model import Model

from .cli_options import (
    JOBS,
    Bags,
    Greedy,
    Jobs,
    LeaveOut,
    MaxEffects,
    ModelFile,
    Objects,
    RigFile,
    Scale,
    Signals,
    Topics,
)
from .page_guard import Guard, address_of
from .page_worker import ANSWER, GRACE_S, MODEL, REPORT
from .prepare import existing

HERE = Path(__file__).parent

DOING = {"read": "Reading the bags", "compare": "Comparing", "diagnose": "Diagnosing", "add": "Adding"}

LONGEST_LINE = 2**24
"""Bytes of one message of the worker; notes of many bags are long."""

DOWNLOADS = {REPORT: "Report (HTML)", ANSWER: "Answer (JSON)", MODEL: "Model file (YAML)"}


# -- the worker -----------------------------------------------------------------------------------------------------
@dataclass
class Round:
    """One bar of the progress."""

    text: str
    done: int
    total: int


@dataclass
class Work:
    """What the page shows, and the process that works on it: one at a time, for all who look at the page.

    settings  what every task is given: bags, model, jobs ...
    folder    where the tasks leave their files
    """

    settings: Mapping[str, Any]
    folder: Path
    action: str = ""
    rounds: list[Round] = field(default_factory=list)
    began: float = 0.0
    ended: float = 0.0
    problem: str = ""
    titles: dict[str, str] = field(default_factory=dict)
    data: Mapping[str, Any] | None = None
    answer: Mapping[str, Any] | None = None
    answers: int = 0
    _task: asyncio.Task[None] | None = None
    _cancelled: bool = False

    @property
    def running(self) -> bool:
        return self._task is not None and not self._task.done()

    def start(self, action: str, **options: Any) -> None:
        """Begin; does nothing while another task runs."""
        if not self.running:
            self.action, self.problem, self.rounds, self._cancelled = action, "", [], False
            self.began, self.ended = time.monotonic(), 0.0
            self._task = asyncio.create_task(self._run({**self.settings, "action": action, **options}))

    async def wait(self) -> None:
        """Return when nothing runs any more."""
        if self._task is not None:
            await self._task

    async def cancel(self) -> None:
        """End the task; what it has found so far is kept in the store."""
        self._cancelled = True
        await self.wait()

    async def _run(self, task: Mapping[str, Any]) -> None:
        folder = Path(tempfile.mkdtemp(dir=self.folder))
        (folder / "task.json").write_text(json.dumps(task, default=str), encoding="utf-8")
        pipes = {"stdin": asyncio.subprocess.PIPE, "stdout": asyncio.subprocess.PIPE, "limit": LONGEST_LINE}
        words = (sys.executable, "-m", "hannes_lab.page_worker", str(folder))
        try:
            # a session of its own: Ctrl-C on the terminal ends the page, which ends the worker
            process = await asyncio.create_subprocess_exec(*words, start_new_session=True, **pipes)  # type: ignore[arg-type]
        except OSError as error:
            self.problem = f"The worker process cannot be started: {error}."
            return
        assert process.stdin is not None and process.stdout is not None
        try:
            reading = asyncio.create_task(self._listen(process.stdout, folder))
            while not reading.done() and not self._cancelled:
                await asyncio.wait([reading], timeout=0.2)
            process.stdin.close()  # which the worker takes for Ctrl-C
            await asyncio.wait([reading], timeout=2.0 * GRACE_S)
        finally:
            self._end_all(process)
            self.ended = time.monotonic()
        code = await process.wait()
        try:
            await reading
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            self.problem = f"The worker process said what cannot be read: {error}."
        if code and self._cancelled:
            self.problem = "Cancelled. What was found is kept: the same button goes on from there."
        elif code and not self.problem:
            how = f"was ended by signal {-code}, perhaps for want of memory" if code < 0 else "failed"
            self.problem = f"The worker process {how}; the terminal may say more. What it had found is kept."

    @staticmethod
    def _end_all(process: asyncio.subprocess.Process) -> None:
        """End the process and those that it started; they share its group."""
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)

    async def _listen(self, lines: asyncio.StreamReader, folder: Path) -> None:
        # a process that is ended may leave half a line
        while (line := await lines.readline()).endswith(b"\n"):
            message = json.loads(line)
            kind = message.pop("kind")
            if kind == "progress":
                self._progress(**message)
            elif kind == "effects":
                self.titles = message["titles"]
            elif kind == "data":
                self.data = message
            elif kind == "error":
                self.problem = message["text"]
            else:
                self.answers += 1
                self.answer = {**message, "number": self.answers, "folder": folder}

    def _progress(self, done: int, total: int, text: str) -> None:
        last = self.rounds[-1] if self.rounds else None
        if last is None or last.text != text or done < last.done:
            self.rounds.append(Round(text, done, total))
        else:
            last.done, last.total = done, total


# -- what it looks like ---------------------------------------------------------------------------------------------
def make_app(work: Work) -> Any:
    """The ASGI application: NiceGUI's, and the files of the last answer."""
    from fastapi import FastAPI, HTTPException
    from fastapi.responses import FileResponse
    from nicegui import ui

    async def file(number: int, name: str, download: bool = False) -> FileResponse:
        answer = work.answer
        if answer is None or number != answer["number"] or name not in answer["files"]:
            raise HTTPException(404, "There is a newer answer; reload the page.")
        headers = {"cache-control": "no-store"}
        return FileResponse(answer["folder"] / name, headers=headers, filename=name if download else None)

    def show() -> None:
        _View(work)

    app = FastAPI(openapi_url=None)
    app.add_api_route("/answer/{number}/{name}", file)
    ui.run_with(
        app, root=show, title="Hannes lab", favicon="🖐", dark=None, tailwind=False, show_welcome_message=False
    )
    return app


class _View:
    """The page in one browser window; it looks twice a second for what has changed."""

    def __init__(self, work: Work) -> None:
        from nicegui import ui

        self.work, self.ui = work, ui
        self._shown = 0
        self._titles: dict[str, str] = {}
        for name in ("report.css", "page.css"):
            ui.add_head_html(f"<style>{(HERE / 'static' / name).read_text(encoding='utf-8')}</style>")
        script = (HERE / "static" / "page.js").read_text(encoding="utf-8")
        ui.add_head_html(f"<script>{script}</script>")
        ui.colors(primary="#1264a8")
        with ui.element("main"):
            ui.html("<h1>Model against measurement</h1>")
            self.data = ui.html().classes("data")
            with ui.element("div").classes("actions"):
                self.compare = ui.button("Compare", on_click=lambda: work.start("compare"))
                self.diagnose = ui.button("Diagnose", on_click=self._diagnose)
                self.cancel = ui.button("Cancel", on_click=work.cancel).props("outline")
            with ui.element("div").classes("actions"):
                self.effects = ui.select(
                    {},
                    label="Effects: choose, or type path.py:Class",
                    multiple=True,
                    new_value_mode="add-unique",
                )
                self.add = ui.button("Add to the model", on_click=self._add)
                self.only = ui.checkbox("Diagnose with these only")
            for button in (self.compare, self.diagnose, self.add, self.cancel):
                button.props("no-caps unelevated")
            self.effects.props("outlined dense use-chips").classes("effects")
            self.progress = ui.html().props("aria-live=polite")
            self.answer = ui.element("div").classes("answer")
        self._refresh()  # at once, so that no button can be pressed that would do nothing
        ui.timer(0.5, self._refresh)

    def _diagnose(self) -> None:
        chosen = list(self.effects.value)
        only = bool(self.only.value and chosen)
        # the catalogue takes part anyway; what is no name of it is refused by name
        self.work.start("diagnose", effects=[e for e in chosen if only or e not in self._titles], only=only)

    def _add(self) -> None:
        self.work.start("add", effects=list(self.effects.value))

    def _refresh(self) -> None:
        work = self.work
        for button in (self.compare, self.diagnose):
            button.set_enabled(not work.running)
        self.add.set_enabled(not work.running and bool(self.effects.value))
        self.only.set_enabled(not work.running and bool(self.effects.value))
        if not self.effects.value:
            self.only.value = False
        self.cancel.set_enabled(work.running)
        if not self._titles and work.titles:
            self._offer(work.titles)
        self.data.content = data_html(work.data, work.settings["bags"])
        self.progress.content = progress_html(work)
        if work.answer and work.answer["number"] != self._shown:
            self._shown = work.answer["number"]
            self._show(work.answer)

    def _offer(self, titles: Mapping[str, str]) -> None:
        """Effects that can be chosen, beside those that are and those that were typed in."""
        self._titles = {**titles, **{name: name for name in self.effects.value}, **self._titles}
        self.effects.set_options(dict(self._titles))

    def _show(self, answer: Mapping[str, Any]) -> None:
        ui, place = self.ui, f"/answer/{answer['number']}"
        if answer["effects"]:
            self._offer({source: self._titles.get(source, source) for source in answer["effects"]})
            self.effects.set_value(list(answer["effects"]))
        self.answer.clear()
        with self.answer:
            ui.html(verdict_html(answer["verdict"]))
            with ui.element("div").classes("actions"):
                for name in answer["files"]:
                    link = ui.link(DOWNLOADS[name], f"{place}/{name}?download=true")
                    link.props(f'download="{name}"').classes("download")
                ui.link("Report in a tab of its own", f"{place}/{REPORT}", new_tab=True).classes("download")
            # its scripts run, but as those of a stranger: they reach nothing of this page
            frame = ui.element("iframe").classes("report").props('sandbox="allow-scripts" title="Report"')
            frame.props(f'src="{place}/{REPORT}"')


def data_html(data: Mapping[str, Any] | None, bags: Sequence[Any]) -> str:
    """The bags with their conditions, closures and signals, and what was noticed in them."""
    if data is None:
        return f'<p class="lead">{html.escape(", ".join(map(str, bags)))}</p>'
    rows = "".join(
        "<tr>"
        f"<th>{html.escape(d['name'])}<small>{html.escape(d['source'])}</small></th>"
        f"<td>{html.escape(', '.join(d['conditions']))}</td><td class='num'>{d['closures']}</td>"
        f"<td>{html.escape(', '.join(s.replace('_', ' ') for s in d['signals']))}</td></tr>"
        for d in data["data"]
    )
    head = "<th>recording</th><th>conditions</th><th class='num'>closures</th><th>signals</th>"
    table = f"<table><thead><tr>{head}</tr></thead><tbody>{rows}</tbody></table>"
    items = "".join(f"<li>{html.escape(note)}</li>" for note in data["notes"])
    notes = f"<details><summary>Notes: {len(data['notes'])}</summary><ul class='notes'>{items}</ul></details>"
    model = f"<p class='lead'>Model: {html.escape(data['model'])}</p>"
    return f"{model}<div class='scroll'>{table}</div>{notes if items else ''}"


def progress_html(work: Work) -> str:
    """What is being done, for how long, and a bar for every round; the reason where it has ended without an answer."""
    if not work.action:
        return ""
    if work.problem:
        return f"<p class='problem' role='alert'>{html.escape(work.problem)}</p>"
    if not work.running:
        return f"<p class='done'>{DOING[work.action]}: done in {_clock(work.ended - work.began)}.</p>"
    bars = "".join(
        f"<div class='round'><span>{html.escape(r.text)}</span>"
        f"<progress max='{max(r.total, 1)}' value='{r.done}'></progress>"
        f"<span class='num'>{r.done}/{r.total}</span></div>"
        for r in work.rounds
    )
    return f"<p class='done'>{DOING[work.action]}: {_clock(time.monotonic() - work.began)}</p>{bars}"


def verdict_html(verdict: Mapping[str, str]) -> str:
    """The verdict in the report's words."""
    kind, label, headline, summary = (
        html.escape(verdict[k]) for k in ("kind", "label", "headline", "summary")
    )
    more = f"<p class='summary'>{summary}</p>" if summary else ""
    return f"<div class='verdict {kind}'><p class='badge'>{label}</p><h2>{headline}</h2>{more}</div>"


def _clock(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"


# -- the command ----------------------------------------------------------------------------------------------------
def page(
    bags: Bags,
    model: ModelFile = None,
    objects: Objects = None,
    scale: Scale = None,
    topics: Topics = None,
    leave_out: LeaveOut = None,
    signals: Signals = None,
    rig: RigFile = None,
    max_effects: MaxEffects = None,
    greedy: Greedy = None,
    jobs: Jobs = JOBS,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port; 0: any that is free.")] = 0,
    host: Annotated[
        str, typer.Option("--host", help="Address to listen at; any but 127.0.0.1 opens the page to others.")
    ] = "127.0.0.1",
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Only print the link.")] = False,
) -> None:
    """Compare, diagnose and add in a web page of this machine."""
    for bag in bags:
        existing(bag)
    if model is not None:
        Model.load(model)  # so that a wrong name is said here, not on the page
    settings: dict[str, Any] = {"bags": [str(b) for b in bags], "model": model, "rig": rig, "jobs": jobs}
    settings |= {
        "objects": objects,
        "scale": scale,
        "topics": topics,
        "leave_out": leave_out,
        "signals": signals,
    }
    settings |= {"max_effects": max_effects, "greedy": greedy}
    with tempfile.TemporaryDirectory(prefix="hannes_page_") as folder, listen(host, port) as listener:
        os.environ["NICEGUI_STORAGE_PATH"] = folder  # else NiceGUI would look for its own folder in this one
        serve(Work(settings, Path(folder)), listener, host, browser=not no_browser)


def listen(host: str, port: int) -> socket.socket:
    """A socket at that address; HannesError where there can be none."""
    try:
        family, kind, protocol, _, place = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.socket(family, kind, protocol)
        try:
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(place)
            listener.listen()  # who follows the link at once waits until the page is there
        except OSError:
            listener.close()
            raise
    except OSError as error:
        raise HannesError(
            f"The page cannot listen at {host}, port {port}: {error.strerror or error}. Give another --port or --host."
        ) from error
    return listener


def serve(work: Work, listener: socket.socket, host: str, *, browser: bool) -> None:
    """Serve until Ctrl-C."""
    try:
        import uvicorn
        from nicegui import app as nicegui_app
    except ImportError as error:
        raise HannesError(
            "The page needs the libraries of the extra 'page': pip install 'hannes_lab[page]'."
        ) from error
    address, port = listener.getsockname()[:2]
    bound = address_of(address)
    off_host = bound is not None and not bound.is_loopback
    names = [host, address, *([socket.gethostname(), socket.getfqdn()] if off_host else [])]
    called = socket.gethostname() if bound is not None and bound.is_unspecified else host
    called = f"[{called}]" if ":" in called else called

    def link() -> str:
        return f"http://{called}:{port}/?token={guard.link_token}"

    def used() -> None:
        print(f"For another browser: {link()}", flush=True)

    guard = Guard(make_app(work), port=port, names=names, any_address=off_host, used=used)

    def started() -> None:
        work.start("read")
        if off_host:
            print(
                f"hannes: warning: other machines reach this page at {address}; nothing is encrypted, and who has the "
                "link can run Python files of this machine as effects.",
                file=sys.stderr,
            )
        print(f"The page, by a link that works once (Ctrl-C ends it): {link()}", flush=True)
        if browser and (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            webbrowser.open(link())

    nicegui_app.on_startup(started)
    nicegui_app.on_shutdown(work.cancel)
    config = uvicorn.Config(
        guard,
        log_level="warning",
        ws="wsproto",
        timeout_graceful_shutdown=2,
        server_header=False,
        proxy_headers=False,
    )
    uvicorn.Server(config).run(sockets=[listener])
