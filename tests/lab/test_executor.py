"""Where a search works changes no number of it, and what was interrupted goes on where it stopped."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_description.output import finite
from hannes_lab.cache import NotPlain, Store, content_hash
from hannes_lab.diagnose import diagnose, effect_sources
from hannes_lab.diagnosis import Diagnosis
from hannes_lab.executor import Executor
from hannes_lab.features import Features
from hannes_lab.fit import Fit
from hannes_lab.hide import make_set, write_set
from hannes_lab.prepare import Prepared, load_trials, prepare
from hannes_lab.problem import Problem
from hannes_lab.search import Candidate, Search
from hannes_sim.effect import strength_of

pytestmark = pytest.mark.slow

ONLY = ["glove_stiffness", "wire_slack", "gravity"]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("set")
    made, truth = make_set(
        Model.load(),
        [strength_of("glove_stiffness", 1.0)],
        seed=401,
        closures=5,
        conditions=("fast", "grasp_fast"),
    )
    write_set(made, truth, folder / "bags", folder / "truth.yaml")
    return folder / "bags"


@pytest.fixture(scope="module")
def prepared(recordings: Path) -> Prepared:
    return prepare(load_trials([recordings]), Model.load())


def found_with(prepared: Prepared, executor: Executor, only: list[str] = ONLY) -> Diagnosis:
    fresh = replace(prepared, problem=replace(prepared.problem, counts=type(prepared.problem.counts)()))
    with executor:
        return diagnose(fresh, effect_sources(only=only), executor=executor, max_effects=1)


@pytest.fixture(scope="module")
def serial(prepared: Prepared) -> Diagnosis:
    return found_with(prepared, Executor())


@pytest.fixture(scope="module")
def kept(prepared: Prepared, tmp_path_factory: pytest.TempPathFactory) -> tuple[Diagnosis, Path]:
    """The same search in two processes, and the folder where its results were kept."""
    folder = tmp_path_factory.mktemp("store")
    return found_with(prepared, Executor(jobs=2, store=Store(folder))), folder


@pytest.fixture(scope="module")
def cluster() -> Iterator[str]:
    """Address of a local Dask cluster of two processes."""
    distributed = pytest.importorskip(
        "distributed", reason="the extra 'cluster' of hannes_lab is not installed"
    )
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None, silence_logs=50
    ) as local:
        yield local.scheduler_address


def same(a: Diagnosis, b: Diagnosis) -> bool:
    """Every number alike, the count of simulations among them."""
    return json.dumps(a.to_dict()) == json.dumps(b.to_dict())


def test_two_processes_give_the_same_numbers(kept: tuple[Diagnosis, Path], serial: Diagnosis) -> None:
    assert [e.name for e in serial.effects] == ["glove_stiffness"]
    assert same(kept[0], serial)


def test_a_dask_cluster_gives_the_same_numbers(cluster: str, prepared: Prepared, serial: Diagnosis) -> None:
    far = found_with(prepared, Executor(dask=cluster))
    assert same(far, serial)


def test_no_scheduler_is_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed", reason="the extra 'cluster' of hannes_lab is not installed")
    monkeypatch.setattr("hannes_lab.executor.CONNECT_S", 1)
    with pytest.raises(HannesError, match="No Dask scheduler"):
        Executor(dask="tcp://127.0.0.1:1").client()


@pytest.fixture
def predictions(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How often the model was asked what it predicts, as its only item."""
    made, predict = [0], Features.predict

    def counted(*given: Any) -> Any:
        made[0] += 1
        return predict(*given)

    monkeypatch.setattr(Features, "predict", counted)
    return made


def test_a_second_run_takes_everything_from_the_store(
    kept: tuple[Diagnosis, Path], prepared: Prepared, serial: Diagnosis, predictions: list[int]
) -> None:
    again = found_with(prepared, Executor(store=Store(kept[1])))
    assert same(again, serial) and predictions[0] < 0.1 * serial.simulations


def test_of_other_effects_that_are_looked_for_the_fits_are_found_again(
    kept: tuple[Diagnosis, Path], prepared: Prepared, predictions: list[int]
) -> None:
    plain = found_with(prepared, Executor(), ONLY[:2])
    anew, predictions[0] = predictions[0], 0
    assert same(found_with(prepared, Executor(store=Store(kept[1])), ONLY[:2]), plain)
    assert predictions[0] < 0.5 * anew


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_result_cannot_depend_on_effects_that_it_does_not_name(prepared: Prepared, jobs: int) -> None:
    """What is kept is found by the effects of an item; the item sees no others."""
    executor = Executor(jobs)
    search = Search(
        prepared.problem, prepared.model, prepared.nuisances, effect_sources(only=ONLY), executor=executor
    )
    null = Candidate((), Fit(prepared.model, (), np.zeros(0), 0.0, np.zeros(0), np.zeros((0, 0))), 0.0)
    glove = replace(null, names=("glove_stiffness",))
    seen = search.each(sees, [(null,), (glove,), (glove, "gravity")], "")
    assert seen == [[], ["glove_stiffness"], ["glove_stiffness", "gravity"]]


def sees(search: Search, *_: Any) -> list[str]:
    assert not (search.found or search._scans or search.before), "what was found elsewhere"
    return sorted(search.sources)


def test_other_data_or_another_model_find_nothing_of_it(prepared: Prepared, tmp_path: Path) -> None:
    def fitted(problem: Problem, model: Model = prepared.model) -> int:
        """Hits of a fit of the nominal."""
        store = Store(tmp_path)
        Search(problem, model, prepared.nuisances, {}, executor=Executor(store=store)).null()
        return store.hits

    problem, block = prepared.problem, prepared.features.blocks[0]
    moved = replace(block, measured=block.measured + 1e-9)
    features = replace(prepared.features, blocks=(moved, *prepared.features.blocks[1:]), slices=())
    stiffer = prepared.model.with_values(
        {"friction.viscous": 1.01 * prepared.model.parameters.value("friction.viscous")}
    )
    assert fitted(problem) == 0 and fitted(problem) == 2, "where it starts, and where it ends"
    assert fitted(replace(problem, features=features)) == 0
    assert fitted(problem, stiffer) == 0


def test_a_file_that_is_read_is_whole(tmp_path: Path) -> None:
    store = Store(tmp_path)
    content = {"kind": "x", "values": [1.5, None, "text", np.arange(5.0), np.zeros((2, 0))]}
    store.write("a" * 64, content)
    back = store.read("a" * 64)
    assert back["kind"] == "x" and back["values"][:3] == [1.5, None, "text"]
    assert np.array_equal(back["values"][3], np.arange(5.0)) and back["values"][4].shape == (2, 0)
    file = tmp_path / ("a" * 64 + ".npz")
    whole = file.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 0xFF
    for broken in (b"", whole[:100], whole[:-30], bytes(flipped), b"not a zip file at all"):
        file.write_bytes(broken)
        assert store.read("a" * 64) is None
        assert not file.exists()
    store.write("a" * 64, content)
    file.rename(tmp_path / ("b" * 64 + ".npz"))
    assert store.read("b" * 64) is None, "a result under another's name"
    assert store.read("c" * 64) is None


def test_the_folder_stays_below_its_limit_and_the_oldest_go_first(tmp_path: Path) -> None:
    store = Store(tmp_path, limit=100_000)
    for k in range(20):
        store.write(f"{k:064d}", [np.full(1000, float(k))])
        os.utime(tmp_path / f"{k:064d}.npz", (k, k))
    assert store.read(f"{0:064d}") is not None, "reading makes it the youngest"
    (tmp_path / "lost.part").write_bytes(b"half")
    os.utime(tmp_path / "lost.part", (0, 0))
    store.prune()
    left = sorted(p.name for p in tmp_path.iterdir())
    assert sum(p.stat().st_size for p in tmp_path.iterdir()) <= 100_000
    assert f"{0:064d}.npz" in left and f"{19:064d}.npz" in left and f"{1:064d}.npz" not in left
    assert "lost.part" not in left


def test_a_run_that_keeps_more_than_the_limit_finds_it_all_again(tmp_path: Path) -> None:
    store = Store(tmp_path, limit=100_000)
    keys = [f"{k:064d}" for k in range(130)]
    for key in keys:
        store.write(key, [np.full(1000, 1.0)])
    again = Store(tmp_path, limit=100_000)
    assert all(again.read(key) is not None for key in keys)
    for key in keys:
        os.utime(tmp_path / f"{key}.npz", (0, 0))
    Store(tmp_path, limit=100_000)
    assert sum(p.stat().st_size for p in tmp_path.iterdir()) <= 100_000


def test_a_folder_that_cannot_be_used_stops_nothing(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "file").write_text("not a folder")
    store = Store(tmp_path / "file")
    store.write("a" * 64, [1.0])
    assert store.read("a" * 64) is None and "results are not kept" in caplog.text


def test_the_hash_is_of_the_content(tmp_path: Path) -> None:
    file = tmp_path / "mine.py"
    file.write_text("class Mine: pass\n")
    source = f"{file}:Mine"
    before = content_hash(source, Model.load())
    assert content_hash(source, Model.load()) == before
    file.write_text("class Mine: x = 1\n")
    assert content_hash(source, Model.load()) != before
    one = content_hash(np.array([0.0, 1.0]), {"a": (1, 2.0, None)})
    assert one == content_hash(np.array([0.0, 1.0]), {"a": (1, 2.0, None)})
    assert one != content_hash(np.array([[0.0, 1.0]]), {"a": (1, 2.0, None)})
    assert content_hash("ab", "c") != content_hash("a", "bc")
    with pytest.raises(NotPlain):
        content_hash(lambda: None)


def run_hannes(words: list[str], cache: Path, **options: object) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, "-m", "hannes_bringup.cli", *words],
        env={k: v for k, v in os.environ.items() if k != "HANNES_NUMBA_CACHE_DIR"}
        | {"XDG_CACHE_HOME": str(cache), "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        **options,  # type: ignore[call-overload]
    )


def ended_in_the_first_round(words: list[str], cache: Path, end: Callable[[int], None]) -> tuple[int, str]:
    """Exit code and standard error of a command that `end` is called for, with its id, once results are kept."""
    process = run_hannes(words, cache)
    kept = cache / "hannes" / "lab"
    begun = 3  # the nominal fit and what chance reaches: far from the end, also on a busy machine
    while process.poll() is None and (not kept.exists() or len(list(kept.glob("*.npz"))) < begun):
        time.sleep(0.02)
    end(process.pid)
    out, err = process.communicate(timeout=60.0)
    assert out == ""
    return process.returncode, err


@pytest.mark.parametrize("kill", [os.kill, os.killpg], ids=["alone", "with its workers"])
def test_sigterm_ends_a_run_as_ctrl_c_does(
    kill: Callable[[int, int], None], recordings: Path, tmp_path: Path
) -> None:
    words = ["diagnose", str(recordings), "--max-effects", "1", "--json", "--jobs", "2"]
    code, err = ended_in_the_first_round(words, tmp_path, lambda process: kill(process, signal.SIGTERM))
    said = "hannes: terminated; what was found is kept: the same command goes on from there"
    assert (code, err.strip().splitlines()) == (143, [said])


def test_workers_end_with_a_command_that_is_killed(recordings: Path, tmp_path: Path) -> None:
    """They hold its output open: what reads it would wait for ever."""
    words = ["diagnose", str(recordings), "--max-effects", "1", "--json", "--jobs", "2"]
    code, _ = ended_in_the_first_round(words, tmp_path, lambda process: os.kill(process, signal.SIGKILL))
    assert code == -signal.SIGKILL


def test_ctrl_c_in_the_first_round_and_the_same_command_goes_on(
    recordings: Path, serial: Diagnosis, tmp_path: Path
) -> None:
    only = [word for name in ONLY for word in ("--only", name)]
    words = ["diagnose", str(recordings), *only, "--max-effects", "1", "--json", "--jobs", "2"]
    # what Ctrl-C does: to the workers as well
    code, err = ended_in_the_first_round(words, tmp_path, lambda process: os.killpg(process, signal.SIGINT))
    said = "hannes: interrupted; what was found is kept: the same command goes on from there"
    assert (code, err.strip().splitlines()) == (130, [said])

    again = run_hannes(words, tmp_path)
    out, err = again.communicate()
    assert again.returncode == 0, err
    found, expected = json.loads(out), json.loads(json.dumps(finite(serial.to_dict())))
    assert found.pop("model_file") is None
    # The command counts those of the preparation too.
    assert found.pop("simulations") >= expected.pop("simulations")
    assert found == expected


def test_without_the_cache_nothing_is_kept(recordings: Path, tmp_path: Path) -> None:
    words = ["diagnose", str(recordings), "--only", "gravity", "--max-effects", "1", "--jobs", "1"]
    process = run_hannes([*words, "--no-cache"], tmp_path)
    _, err = process.communicate()
    assert process.returncode == 0, err
    assert not (tmp_path / "hannes" / "lab").exists()
