"""The lab's web page: the answers of compare, diagnose and add, and how far the work is, in a browser.

The page computes nothing: a worker process (page_worker.py) does what the commands do, and what it found is shown as the
report of the command line.  The page is served to this machine alone and to nobody without the link on the terminal.
"""

from __future__ import annotations

import asyncio
import hmac
import html
import ipaddress
import json
import os
import secrets
import signal
import socket
import sys
import tempfile
import time
import webbrowser
from collections.abc import Awaitable, Callable, Mapping, MutableMapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from http.cookies import CookieError, SimpleCookie
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import parse_qs

import typer
from hannes_description.errors import HannesError

from .cli import _JOBS, Bags, Greedy, Jobs, MaxEffects, ModelFile, Objects, RigFile, Scale, Signals
from .diagnose import MAX_EFFECTS
from .page_worker import ANSWER, GRACE_S, MODEL, REPORT

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
    began: float


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
    _process: asyncio.subprocess.Process | None = None
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
        if self._process is not None and self._process.stdin is not None:
            self._process.stdin.close()  # which the worker takes for Ctrl-C
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
        self._process = process
        if self._cancelled and process.stdin is not None:
            process.stdin.close()
        try:
            assert process.stdout is not None
            reading = asyncio.create_task(self._listen(process.stdout, folder))
            while not reading.done():
                # the worker ends itself GRACE_S after it is told to, unless it is stuck
                await asyncio.wait([reading], timeout=2.0 * GRACE_S if self._cancelled else 0.5)
                if self._cancelled and not reading.done():
                    break
            self._end_all(process)
            code = await process.wait()
            await reading
        finally:
            self._end_all(process)
            self._process, self.ended = None, time.monotonic()
        if self._cancelled:
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
        while line := await lines.readline():
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
            self.rounds.append(Round(text, done, total, time.monotonic()))
        else:
            last.done, last.total = done, total


# -- who may see the page -------------------------------------------------------------------------------------------
Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Any]]
Send = Callable[[Any], Awaitable[None]]

ENTRY = b'<!doctype html><meta http-equiv="refresh" content="0;url=/"><title>Hannes</title><p><a href="/">Go on</a>'
"""Not a redirection: a link that was followed from another site would be refused the cookie."""

REFUSAL = b"Refused. Open the page by the link on the terminal where `hannes page` runs; a link works once.\n"


class Guard:
    """Lets in who holds the cookie, which the link of the terminal is exchanged for; everybody else gets 403.

    Host must name this machine, so that no foreign name can be pointed at it (DNS rebinding); Origin must be the page's
    own, so that no foreign page can act through the user's browser.
    """

    def __init__(self, app: Any, *, port: int, names: Sequence[str] = (), any_address: bool = False,
                 used: Callable[[], None] | None = None) -> None:  # fmt: skip
        """Guard an ASGI application.

        names        names and addresses beside those of the loopback by which it may be called
        any_address  any numeric address is right: a foreign name is none
        used         is called when a link was used; the next one is `link_token`
        """
        self.app = app
        self.cookie = f"hannes_page_{port}"  # cookies of one host are shared by its ports
        self.link_token = secrets.token_urlsafe(32)
        self._sessions: set[str] = set()
        self._names = {"localhost", "127.0.0.1", "::1", *(n.lower() for n in names)}
        self._any_address = any_address
        self._used = used

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            await self.app(scope, receive, send)
            return
        headers: dict[str, list[str]] = {}
        for name, value in scope["headers"]:
            headers.setdefault(name.decode("latin-1").lower(), []).append(value.decode("latin-1"))
        if not self._at_home(scope, headers):
            await _refuse(scope, send)
        elif self._known(headers):
            await self._pass(scope, receive, _with_headers(send, headers["host"][0]))
        elif self._enters(scope):
            session = secrets.token_urlsafe(32)
            self._sessions.add(session)
            self.link_token = secrets.token_urlsafe(32)
            cookie = f"{self.cookie}={session}; Path=/; HttpOnly; SameSite=Strict"
            await _answer(send, 200, ENTRY, b"text/html; charset=utf-8", [(b"set-cookie", cookie.encode())])
            if self._used:
                self._used()
        else:
            await _refuse(scope, send)

    async def _pass(self, scope: Scope, receive: Receive, send: Send) -> None:
        gone = False

        async def noted() -> Any:
            nonlocal gone
            message = await receive()
            gone = gone or message["type"] == "http.disconnect"
            return message

        try:
            await self.app(scope, noted, send)
        except RuntimeError:
            if not gone:  # a browser that closed the page before it was answered is no error
                raise

    def _at_home(self, scope: Scope, headers: Mapping[str, list[str]]) -> bool:
        host, origin = headers.get("host", []), headers.get("origin", [])
        if len(host) != 1 or len(origin) > 1 or not self._named(host[0]):
            return False
        if not origin:  # browsers send none with what only reads
            return scope["type"] == "http" and scope["method"] in ("GET", "HEAD")
        return origin[0].lower() in (f"http://{host[0].lower()}", f"https://{host[0].lower()}")

    def _named(self, host: str) -> bool:
        name, colon, port = host.lower().rpartition(":")
        if not colon or not port.isdecimal():
            name = host.lower()
        name = name.removeprefix("[").removesuffix("]")
        return name in self._names or (self._any_address and _address(name) is not None)

    def _known(self, headers: Mapping[str, list[str]]) -> bool:
        try:
            cookie = SimpleCookie("; ".join(headers.get("cookie", []))).get(self.cookie)
        except CookieError:
            return False
        given = cookie.value.encode() if cookie else b""
        return any(hmac.compare_digest(given, session.encode()) for session in self._sessions)

    def _enters(self, scope: Scope) -> bool:
        if scope["type"] != "http" or scope["method"] != "GET" or scope["path"] != "/":
            return False
        given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        return hmac.compare_digest(given.encode(), self.link_token.encode())


def _with_headers(send: Send, host: str) -> Send:
    """Answers that the browser may use for this page only, and which may load nothing from elsewhere."""
    policy = (
        "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
        f"img-src 'self' data:; font-src 'self' data:; connect-src 'self' ws://{host} wss://{host}; "
        "object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors 'self'"
    )

    async def add(message: Any) -> None:
        if message["type"] == "http.response.start":
            message["headers"] = [*message.get("headers", []), *PRIVATE,
                                  (b"content-security-policy", policy.encode("latin-1"))]  # fmt: skip
        await send(message)

    return add


PRIVATE = [
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cross-origin-opener-policy", b"same-origin"),
]


async def _answer(send: Send, status: int, body: bytes, kind: bytes, more: Sequence[tuple[bytes, bytes]] = ()) -> None:
    length = str(len(body)).encode()
    headers = [(b"content-type", kind), (b"content-length", length), (b"cache-control", b"no-store"), *PRIVATE, *more]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})


async def _refuse(scope: Scope, send: Send) -> None:
    if scope["type"] == "websocket":
        await send({"type": "websocket.close", "code": 1008})  # before it is accepted: the server answers 403
    else:
        await _answer(send, 403, REFUSAL, b"text/plain; charset=utf-8")


def _address(name: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(name)
    except ValueError:
        return None


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
        kind = {"filename": name} if download else {}
        return FileResponse(answer["folder"] / name, headers={"cache-control": "no-store"}, **kind)

    def show() -> None:
        _View(work)

    app = FastAPI(openapi_url=None)
    app.add_api_route("/answer/{number}/{name}", file)
    ui.run_with(app, root=show, title="Hannes lab", favicon="🖐", dark=None, tailwind=False, show_welcome_message=False)
    return app


class _View:
    """The page in one browser window; it looks twice a second for what has changed."""

    def __init__(self, work: Work) -> None:
        from nicegui import ui

        self.work, self.ui = work, ui
        self._shown = 0
        style = (HERE / "static" / "report.css").read_text(encoding="utf-8")
        ui.add_head_html(f"<style>{style}\n{(HERE / 'static' / 'page.css').read_text(encoding='utf-8')}</style>")
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
                    {}, label="Effects: choose, or type path.py:Class", multiple=True, new_value_mode="add-unique"
                )
                self.add = ui.button("Add to the model", on_click=self._add)
                self.only = ui.checkbox("Diagnose with these only")
            for button in (self.compare, self.diagnose, self.add, self.cancel):
                button.props("no-caps unelevated")
            self.effects.props("outlined dense use-chips").classes("effects")
            self.progress = ui.html().props("aria-live=polite")
            self.answer = ui.element("div").classes("answer")
        ui.timer(0.5, self._refresh)

    def _diagnose(self) -> None:
        chosen, only = list(self.effects.value), bool(self.only.value)
        # the catalogue takes part anyway
        self.work.start("diagnose", effects=[e for e in chosen if only or ":" in e], only=only)

    def _add(self) -> None:
        self.work.start("add", effects=list(self.effects.value))

    def _refresh(self) -> None:
        work = self.work
        for button in (self.compare, self.diagnose):
            button.set_enabled(not work.running)
        self.add.set_enabled(not work.running and bool(self.effects.value))
        self.only.set_enabled(not work.running and bool(self.effects.value))
        self.cancel.set_enabled(work.running)
        new = {name: title for name, title in work.titles.items() if name not in self.effects.options}
        if new:
            self.effects.set_options({**new, **self.effects.options})
        self.data.content = data_html(work.data, work.settings["bags"])
        self.progress.content = progress_html(work)
        if work.answer and work.answer["number"] != self._shown:
            self._shown = work.answer["number"]
            self._show(work.answer)

    def _show(self, answer: Mapping[str, Any]) -> None:
        ui, place = self.ui, f"/answer/{answer['number']}"
        if answer["effects"]:
            own = {source: source for source in answer["effects"] if source not in self.effects.options}
            self.effects.set_options({**self.effects.options, **own}, value=answer["effects"])
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
    cells = "".join(
        "<tr>"
        f"<th>{html.escape(d['name'])}<small>{html.escape(d['source'])}</small></th>"
        f"<td>{html.escape(', '.join(d['conditions']))}</td><td class='num'>{d['closures']}</td>"
        f"<td>{html.escape(', '.join(s.replace('_', ' ') for s in d['signals']))}</td></tr>"
        for d in data["data"]
    )
    notes = "".join(f"<li>{html.escape(note)}</li>" for note in data["notes"])
    return (
        f"<p class='lead'>Model: {html.escape(data['model'])}</p><div class='scroll'><table><thead><tr><th>recording</th>"
        f"<th>conditions</th><th class='num'>closures</th><th>signals</th></tr></thead><tbody>{cells}</tbody></table></div>"
        + (f"<details><summary>{len(data['notes'])} notes</summary><ul class='notes'>{notes}</ul></details>" if notes else "")
    )


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
        f"<progress max='{max(r.total, 1)}' value='{r.done}'></progress><span class='num'>{r.done}/{r.total}</span></div>"
        for r in work.rounds
    )
    return f"<p class='done'>{DOING[work.action]}: {_clock(time.monotonic() - work.began)}</p>{bars}"


def verdict_html(verdict: Mapping[str, str]) -> str:
    """The verdict in the report's words."""
    kind, label, headline, summary = (html.escape(verdict[k]) for k in ("kind", "label", "headline", "summary"))
    lines = f"<p class='badge'>{label}</p><h2>{headline}</h2>" + (f"<p class='summary'>{summary}</p>" if summary else "")
    return f"<div class='verdict {kind}'>{lines}</div>"


def _clock(seconds: float) -> str:
    return f"{int(seconds) // 60}:{int(seconds) % 60:02d}"


# -- the command ----------------------------------------------------------------------------------------------------
def page(
    bags: Bags,
    model: ModelFile = "nominal",
    objects: Objects = None,
    scale: Scale = None,
    signals: Signals = None,
    rig: RigFile = None,
    max_effects: MaxEffects = MAX_EFFECTS,
    greedy: Greedy = False,
    jobs: Jobs = _JOBS,
    port: Annotated[int, typer.Option("--port", min=0, max=65535, help="Port; 0: any that is free.")] = 0,
    host: Annotated[
        str, typer.Option("--host", help="Address to listen at; any but 127.0.0.1 opens the page to others.")
    ] = "127.0.0.1",
    no_browser: Annotated[bool, typer.Option("--no-browser", help="Only print the link.")] = False,
) -> None:
    """Compare, diagnose and add in a web page of this machine."""
    settings = {"bags": [str(b) for b in bags], "model": model, "rig": rig, "objects": objects, "scale": scale}
    settings |= {"signals": signals, "max_effects": max_effects, "greedy": greedy, "jobs": jobs}
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
        except OSError:
            listener.close()
            raise
    except OSError as error:
        raise HannesError(
            f"The page cannot listen at {host}, port {port}: {error.strerror or error}. Choose another --port or --host."
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
    bound = _address(address)
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
        guard, log_level="warning", ws="wsproto", timeout_graceful_shutdown=2, server_header=False, proxy_headers=False
    )
    uvicorn.Server(config).run(sockets=[listener])
