"""The lab's page: who may see it, what its worker answers, and the whole of it in a browser."""

from __future__ import annotations

import asyncio
import contextlib
import http.client
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_lab import page, page_worker
from hannes_lab.hide import make_set, write_set
from hannes_lab.page import Work
from hannes_lab.page_guard import Guard
from hannes_sim.effect import strength_of
from lab.foreign_bags import hannes
from patience import PATIENCE

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FEW = ["glove_stiffness", "wire_slack"]
HERE = ("host", "127.0.0.1:8080")


# -- who may see it -------------------------------------------------------------------------------------------------
async def inner(scope: Any, receive: Any, send: Any) -> None:
    """Stands for the page behind the guard."""
    if scope["type"] == "websocket":
        await send({"type": "websocket.accept"})
        return
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body", "body": b"inside"})


def ask(
    guard: Guard,
    *headers: tuple[str, str],
    path: str = "/",
    query: str = "",
    method: str = "GET",
    kind: str = "http",
) -> tuple[int, dict[str, str], bytes]:
    """Status, headers and body of one request; for a websocket 101 or 403."""
    sent: list[dict[str, Any]] = []

    async def send(message: dict[str, Any]) -> None:
        sent.append(message)

    async def receive() -> dict[str, Any]:
        return {"type": f"{kind}.disconnect"}

    scope = {
        "type": kind,
        "method": method,
        "path": path,
        "query_string": query.encode(),
        "headers": [(name.encode(), value.encode()) for name, value in headers],
    }
    asyncio.run(guard(scope, receive, send))
    if kind == "websocket":
        return {"websocket.accept": 101, "websocket.close": 403}[sent[0]["type"]], {}, b""
    named = {name.decode(): value.decode() for name, value in sent[0]["headers"]}
    return sent[0]["status"], named, b"".join(m.get("body", b"") for m in sent[1:])


def enter(guard: Guard) -> tuple[str, str]:
    """The cookie header of somebody who used the link."""
    status, headers, _ = ask(guard, HERE, query=f"token={guard.link_token}")
    assert status == 200
    return "cookie", headers["set-cookie"].split(";")[0]


def test_the_link_works_once_and_gives_a_cookie() -> None:
    told: list[str] = []
    guard = Guard(inner, port=8080, used=lambda: told.append("used"))
    token = guard.link_token
    status, headers, body = ask(guard, HERE, query=f"token={token}")
    assert status == 200 and b"inside" not in body and told == ["used"]
    parts = headers["set-cookie"].split("; ")
    assert {"Path=/", "HttpOnly", "SameSite=Strict"} == set(parts[1:]) and token not in parts[0]
    assert headers["cache-control"] == "no-store" and headers["referrer-policy"] == "no-referrer"
    assert ask(guard, HERE, query=f"token={token}")[0] == 403, "a second time"
    assert guard.link_token != token
    assert ask(guard, HERE, ("cookie", parts[0]))[2] == b"inside"
    second = enter(guard)
    assert ask(guard, HERE, ("cookie", f'odd="{{"; {second[1]}'))[2] == b"inside", (
        "beside another's odd cookie"
    )


@pytest.mark.parametrize("path", ["/", "/answer/1/report.html", "/_nicegui_ws/socket.io/", "/_nicegui/x.js"])
def test_nothing_without_the_cookie(path: str) -> None:
    guard = Guard(inner, port=8080)
    enter(guard)
    wrong = [(), (("cookie", guard.cookie + "="),), (("cookie", f"{guard.cookie}=guess"),)]
    for cookie in wrong:
        for query in ("", "token=", "token=guess"):
            status, _, body = ask(guard, HERE, *cookie, path=path, query=query)
            assert status == 403 and b"inside" not in body
        origin = ("origin", "http://127.0.0.1:8080")
        assert ask(guard, HERE, origin, *cookie, path=path, method="POST")[0] == 403
        assert ask(guard, HERE, origin, *cookie, path=path, kind="websocket")[0] == 403
    if path != "/":
        assert ask(guard, HERE, path=path, query=f"token={guard.link_token}")[0] == 403


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("127.0.0.1:8080", 200),
        ("localhost:9000", 200),  # a tunnel may end at another port
        ("[::1]:8080", 200),
        ("LOCALHOST", 200),
        ("evil.example:8080", 403),
        ("127.0.0.1.evil.example", 403),
        ("192.168.1.5:8080", 403),
        ("", 403),
    ],
)
def test_the_host_must_be_this_machine(host: str, status: int) -> None:
    guard = Guard(inner, port=8080)
    cookie = enter(guard)
    assert ask(guard, ("host", host), cookie)[0] == status
    assert ask(guard, ("host", host), query=f"token={guard.link_token}")[0] == status


def test_hosts_of_a_page_that_others_may_see() -> None:
    guard = Guard(inner, port=8080, names=["lab7"], any_address=True)
    cookie = enter(guard)
    for host, status in (
        ("lab7:8080", 200),
        ("192.168.1.5:8080", 200),
        ("[fe80::1]", 200),
        ("evil.example", 403),
    ):
        assert ask(guard, ("host", host), cookie)[0] == status
    assert ask(guard, cookie)[0] == 403, "no host"
    assert ask(guard, ("host", "lab7"), ("host", "lab7"), cookie)[0] == 403, "two hosts"


@pytest.mark.parametrize(
    ("origin", "allowed"),
    [
        ("http://127.0.0.1:8080", True),
        ("http://127.0.0.1:9999", False),
        ("http://localhost:8080", False),
        ("http://evil.example", False),
        ("null", False),
        (None, False),
    ],
)
def test_the_origin_must_be_the_page(origin: str | None, allowed: bool) -> None:
    guard = Guard(inner, port=8080)
    cookie = enter(guard)
    headers = [HERE, cookie, *([("origin", origin)] if origin else [])]
    assert ask(guard, *headers, kind="websocket")[0] == (101 if allowed else 403)
    assert ask(guard, *headers, method="POST")[0] == (200 if allowed else 403)
    assert ask(guard, *headers)[0] == (200 if allowed or origin is None else 403)


def test_answers_may_load_nothing_from_elsewhere() -> None:
    guard = Guard(inner, port=8080)
    _, headers, _ = ask(guard, HERE, enter(guard))
    policy = headers["content-security-policy"]
    assert "default-src 'self'" in policy and "frame-ancestors 'self'" in policy
    places = [source for source in policy.replace(";", " ").split() if ":/" in source]
    assert places and all(source.endswith("//127.0.0.1:8080") for source in places)


# -- the worker -----------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("set")
    effect = strength_of("glove_stiffness", 1.0)
    made, truth = make_set(Model.load(), [effect], seed=401, closures=5, conditions=["slow", "fast"])
    write_set(made, truth, folder / "bags", folder / "truth.yaml")
    return folder / "bags"


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of results of this test alone; compiled code stays where it is."""
    monkeypatch.delenv("HANNES_NUMBA_CACHE_DIR", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "hannes" / "lab"


def settings(bags: Path | str) -> dict[str, Any]:
    return {"bags": [str(bags)], "model": None, "max_effects": 1, "greedy": False, "jobs": 1}


def test_the_command_of_the_answer_names_the_topics() -> None:
    task = {**settings("bags"), "action": "compare", "topics": ["motor_current=/rig/iq", "grip_force="]}
    said = "hannes compare bags --topic motor_current=/rig/iq --topic grip_force= --report report.html"
    assert page_worker.command_line(task) == said


def test_the_command_of_the_answer_leaves_out_what_was_left_out() -> None:
    task = {**settings("bags"), "action": "diagnose", "max_effects": None, "greedy": None}
    assert page_worker.command_line(task) == "hannes diagnose bags --add --report report.html"
    assert "--no-greedy --max-effects 2" in page_worker.command_line(
        {**task, "greedy": False, "max_effects": 2}
    )
    assert "--greedy" in page_worker.command_line({**task, "greedy": True}).split()


def files_of(work: Work) -> dict[str, Path]:
    assert work.answer is not None, work.problem
    return {name: work.answer["folder"] / name for name in work.answer["files"]}


def test_compare_answers_what_the_command_prints(
    bags: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    async def go() -> Work:
        work = Work(settings(bags), tmp_path)
        work.start("compare")
        await work.wait()
        return work

    work = asyncio.run(go())
    assert not work.problem and not work.running and "glove_stiffness" in work.titles
    assert work.data is not None and [d["closures"] for d in work.data["data"]] == [5, 5]
    files = files_of(work)
    assert list(files) == ["report.html", "answer.json"]
    code, out, _ = hannes("compare", str(bags), "--json", capsys=capsys, monkeypatch=monkeypatch)
    assert code == 0 and json.loads(files["answer.json"].read_text()) == json.loads(out)
    assert work.answer is not None and work.answer["verdict"]["headline"] in files["report.html"].read_text()


def test_cancelled_and_gone_on_a_diagnosis_is_that_of_the_command(
    bags: Path,
    tmp_path: Path,
    store: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async def go() -> Work:
        work = Work(settings(bags), tmp_path)
        work.start("diagnose", effects=FEW, only=True)
        while work.running and not any("scan" in r.text for r in work.rounds):
            await asyncio.sleep(0.02)
        await work.cancel()
        assert not work.running and "Cancelled" in work.problem and work.answer is None
        kept = len(list(store.glob("*.npz")))
        assert kept > 0
        work.start("diagnose", effects=FEW, only=True)
        work.start("compare")  # one at a time: does nothing
        await work.wait()
        assert work.action == "diagnose" and len(list(store.glob("*.npz"))) > kept
        return work

    work = asyncio.run(go())
    files = files_of(work)
    assert list(files) == ["report.html", "answer.json", "my_hand.yaml"]
    assert work.answer is not None and work.answer["effects"] == ["glove_stiffness"]
    assert work.answer["verdict"]["kind"] == "effects" and all(r.done <= r.total for r in work.rounds)
    assert [e.name for e in Model.load(files["my_hand.yaml"]).effects] == ["glove_stiffness"]
    # the command that the report names says the same
    words = work.answer["command"].split()
    monkeypatch.chdir(tmp_path)
    code, out, _ = hannes(*words[1:], "--json", "--jobs", "1", capsys=capsys, monkeypatch=monkeypatch)
    mine, its = json.loads(files["answer.json"].read_text()), json.loads(out)
    assert code == 0 and its.pop("model_file") == "my_hand.yaml"
    assert mine == its
    assert Model.load("my_hand.yaml").sha256 == Model.load(files["my_hand.yaml"]).sha256


def test_add_in_this_process(bags: Path, tmp_path: Path, store: Path) -> None:
    said: list[Any] = []
    task = {**settings(bags), "action": "add", "effects": ["glove_stiffness"]}
    page_worker.work(task, tmp_path, said.append)
    done = said[-1]
    assert done["kind"] == "done" and done["verdict"]["label"] == "Added"
    assert "The error on held-out closures falls" in done["verdict"]["summary"]
    assert [e.name for e in Model.load(tmp_path / "my_hand.yaml").effects] == ["glove_stiffness"]
    with pytest.raises(HannesError, match="Unknown effect 'wire_slak'"):
        page_worker.work({**task, "effects": ["wire_slak"]}, tmp_path, said.append)
    with pytest.raises(HannesError, match="in the model already"):
        page_worker.work({**task, "model": str(tmp_path / "my_hand.yaml")}, tmp_path, said.append)


def test_a_mistake_is_one_sentence_on_the_page(tmp_path: Path) -> None:
    async def go() -> Work:
        work = Work(settings("no/such/<b>bag</b>"), tmp_path)
        work.start("read")
        await work.wait()
        return work

    work = asyncio.run(go())
    assert work.problem == "No bag 'no/such/<b>bag</b>': the path does not exist."
    assert "&lt;b&gt;bag" in page.progress_html(work) and "Traceback" not in work.problem


def test_a_worker_that_dies_is_said(bags: Path, tmp_path: Path) -> None:
    async def go() -> Work:
        work = Work({**settings(bags), "bags": [5]}, tmp_path)  # not what the command line would pass on
        work.start("read")
        await work.wait()
        return work

    assert "The worker process failed" in asyncio.run(go()).problem


def test_texts_of_bags_are_no_html() -> None:
    recording = {
        "name": "<i>",
        "source": "<script>",
        "conditions": ["<b>"],
        "closures": 3,
        "signals": ["<u>"],
    }
    made = page.data_html({"data": [recording], "notes": ["<p>"], "model": "<a>"}, [])
    assert not any(text in made for text in ("<i>", "<script>", "<b>", "<u>", "<p>", "<a>"))
    words = {"kind": "other", "label": "<i>", "headline": "<script>", "summary": "<b>"}
    assert not any(text in page.verdict_html(words) for text in ("<i>", "<script>", "<b>"))


# -- the command ----------------------------------------------------------------------------------------------------
def test_without_nicegui_one_line(
    bags: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "nicegui", None)
    code, _, err = hannes("page", str(bags), "--no-browser", capsys=capsys, monkeypatch=monkeypatch)
    assert code == 2 and "pip install 'hannes_lab[page]'" in err and len(err.strip().splitlines()) == 1


def test_an_address_that_is_none(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    words = ("page", "bags", "--no-browser", "--host", "192.0.2.1")
    code, _, err = hannes(*words, capsys=capsys, monkeypatch=monkeypatch)
    assert code == 2 and "cannot listen at 192.0.2.1" in err and len(err.strip().splitlines()) == 1


@contextlib.contextmanager
def running(*words: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """A page that is being served, and its link; ended by Ctrl-C."""
    pytest.importorskip("nicegui", reason="the extra 'page' of hannes_lab is not installed")
    process = subprocess.Popen(
        [sys.executable, "-m", "hannes_bringup.cli", "page", *words, "--no-browser", "--jobs", "1"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env={name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        assert "a link that works once" in line, line + process.stdout.read()
        yield process, line.split()[-1]
        process.send_signal(signal.SIGINT)
        rest, _ = process.communicate(timeout=PATIENCE)
        assert process.returncode == 130 and "Traceback" not in rest, rest
    finally:
        process.kill()
        process.wait()


class Browser:
    """Chromium without a window, told what to do over a pair of pipes (the Chrome DevTools protocol)."""

    def __init__(self, folder: Path) -> None:
        assert CHROMIUM is not None
        theirs, self._to = os.pipe()
        self._from, theirs_too = os.pipe()
        options = ["--headless", "--no-sandbox", "--disable-gpu", "--disable-background-networking"]
        options += ["--no-first-run", "--remote-debugging-pipe", f"--user-data-dir={folder}", "about:blank"]
        # the pipes are the descriptors 3 and 4 of the browser
        shell = f'exec "$@" 3<&{theirs} 4>&{theirs_too}'
        self._process = subprocess.Popen(
            ["bash", "-c", shell, "-", CHROMIUM, *options],
            pass_fds=(theirs, theirs_too),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(theirs)
        os.close(theirs_too)
        self._rest, self._number, self._session = b"", 0, ""
        self.addresses: list[str] = []
        self.logs: list[str] = []
        targets = self.call("Target.getTargets")["targetInfos"]
        target = next(t["targetId"] for t in targets if t["type"] == "page")
        self._session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        for domain in ("Page", "Network", "Log", "Runtime"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._to, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._read()
            if answer.get("id") == self._number:
                assert "error" not in answer, answer
                return answer["result"]
            self._note(answer.get("method", ""), answer.get("params", {}))

    def _read(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            piece = os.read(self._from, 65536)
            assert piece, "the browser has ended"
            self._rest += piece
        line, _, self._rest = self._rest.partition(b"\0")
        return json.loads(line)

    def _note(self, event: str, content: dict[str, Any]) -> None:
        if event == "Network.requestWillBeSent":
            self.addresses.append(content["request"]["url"])
        elif event == "Network.webSocketCreated":
            self.addresses.append(content["url"])
        elif event == "Log.entryAdded":
            self.logs.append(content["entry"]["text"])
        elif event == "Runtime.exceptionThrown":
            self.logs.append(str(content["exceptionDetails"]))

    def find(self, script: str) -> Any:
        return self.call("Runtime.evaluate", expression=script, returnByValue=True)["result"].get("value")

    async def until(self, script: str) -> Any:
        while not (found := self.find(script)):
            await asyncio.sleep(0.05)
        return found

    def close(self) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._to)
        os.close(self._from)


def status_of(port: int, path: str, headers: Sequence[tuple[str, str]] = (), method: str = "GET") -> int:
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE)
    connection.putrequest(method, path, skip_host=any(name.lower() == "host" for name, _ in headers))
    for name, value in headers:
        connection.putheader(name, value)
    connection.endheaders()
    with contextlib.closing(connection):
        return connection.getresponse().status


UPGRADE = [
    ("Connection", "Upgrade"),
    ("Upgrade", "websocket"),
    ("Sec-WebSocket-Version", "13"),
    ("Sec-WebSocket-Key", "MDEyMzQ1Njc4OTAxMjM0NQ=="),
]


@pytest.mark.skipif(CHROMIUM is None, reason="no chromium on this machine")
def test_the_page_in_a_browser(bags: Path, tmp_path: Path) -> None:
    with running(str(bags)) as (_, link):
        own = urlsplit(link)
        assert own.hostname == "127.0.0.1" and own.port is not None
        socket = "/_nicegui_ws/socket.io/?EIO=4&transport="
        origin = [("Origin", f"http://127.0.0.1:{own.port}")]
        for path in ("/", "/?token=guess", "/answer/1/report.html", "/favicon.ico", socket + "polling"):
            assert status_of(own.port, path) == 403, path
        assert status_of(own.port, "/", [("Host", "evil.example")]) == 403
        assert status_of(own.port, socket + "polling", origin, "POST") == 403
        assert status_of(own.port, socket + "websocket", [*UPGRADE, *origin]) == 403

        browser = Browser(tmp_path / "profile")
        try:
            shown = asyncio.run(asyncio.wait_for(look(browser, link), timeout=4 * PATIENCE))
        finally:
            browser.close()
        assert "slow" in shown and "encoder position" in shown and "Comparison" in shown.title()
        assert "The model misses the closures by" in shown
        # the page, its websocket and the report: nothing of another origin
        places = {
            urlsplit(a)[:2] for a in browser.addresses if not a.startswith(("data:", "about:", "blob:"))
        }
        assert places == {("http", own.netloc), ("ws", own.netloc)}
        assert any(a.endswith("/answer/1/report.html") for a in browser.addresses)
        assert browser.logs == []
        assert status_of(own.port, f"{own.path}?{own.query}") == 403, "the link a second time"


async def look(browser: Browser, link: str) -> str:
    """Open the page, press Compare, and return what the page says when the report is there."""
    browser.call("Page.navigate", url=link)
    buttons = "[...document.querySelectorAll('button')]"
    press = f"(b => b && !b.disabled && !b.click())({buttons}.find(b => b.innerText.trim() == 'Compare'))"
    await browser.until("document.body && document.querySelector('main table') != null")
    await browser.until(press)
    await browser.until("document.querySelector('iframe.report') != null")
    assert browser.find("document.cookie") == "", "scripts cannot read the cookie"
    # the report stands in the frame, without access to the page around it
    assert browser.find("document.querySelector('iframe.report').contentDocument") is None
    while not any(address.endswith("report.html") for address in browser.addresses):
        browser.find("1")
        await asyncio.sleep(0.05)
    # it is as tall as what it shows: only the page around it scrolls
    whole = (
        "document.querySelector('iframe.report').clientHeight > 2000 && document.documentElement.scrollHeight"
    )
    assert await browser.until(whole) > 2000
    return str(browser.find("document.querySelector('main').innerText"))
