"""Cut and mutated bags: one HannesError or a reading, never another exception, within bounds."""

import contextlib
import random
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
import zstandard
from bags.bag_samples import MOTOR, foreign_bag, motor_messages, recording
from hannes_bags import cdr
from hannes_bags.mcap_file import MAGIC
from hannes_bags.reading import bag_info, read_bag
from hannes_bags.recover import recover
from hannes_bags.writing import write_recording
from hannes_description.errors import HannesError
from patience import PATIENCE
from rosbags.rosbag2 import StoragePlugin

pytestmark = pytest.mark.filterwarnings("ignore::hannes_bags.reading.RecordingWarning")
STAMPS = np.arange(1, 121, dtype=np.int64) * 1_000_000


def attempt(path: Path) -> str:
    """What a reader gets; raises if it gets anything but a Recording or a HannesError."""
    try:
        read_bag(path)
    except HannesError as error:
        assert str(error).strip() and "\n" not in str(error)
        return "refused"
    return "read"


def make(kind: str, folder: Path) -> Path:
    """A small bag as a single storage file."""
    if kind in ("none", "zstd"):
        made = recording(n=120, names=(*MOTOR, "joint_positions", "stiffness_label", "stiffness_probability"))
        return write_recording(made, folder / "bag", compression=kind) / "bag_0.mcap"  # type: ignore[arg-type]
    storage = StoragePlugin.SQLITE3 if kind == "sqlite3" else StoragePlugin.MCAP
    path = foreign_bag(folder / "bag", motor_messages(STAMPS), storage)
    return next(file for file in path.iterdir() if file.suffix in (".mcap", ".db3"))


KINDS = ["none", "zstd", "rosbags", "sqlite3"]


@pytest.mark.parametrize("kind", KINDS)
def test_cut_anywhere(tmp_path: Path, kind: str) -> None:
    file = make(kind, tmp_path)
    data = file.read_bytes()
    places = sorted({0, 1, 7, 8, 9, 20, len(data) - 1, *(len(data) * k // 150 for k in range(150))})
    for place in places:
        file.write_bytes(data[:place])
        if kind == "sqlite3":
            attempt(file)
        else:
            with pytest.raises(HannesError, match=r"is damaged: .* \(at byte \d+\)\. Run `hannes recover"):
                read_bag(file)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("seed", range(4))
def test_mutated_bytes(tmp_path: Path, kind: str, seed: int) -> None:
    file = make(kind, tmp_path)
    data = file.read_bytes()
    rng = random.Random(f"{kind}{seed}")
    seen = {"read": 0, "refused": 0}
    for _ in range(60):
        mutant = bytearray(data)
        for _ in range(rng.choice((1, 1, 2, 8, 64))):
            place = rng.randrange(len(mutant))
            how = rng.randrange(5)
            if how == 0:
                mutant[place] ^= 1 << rng.randrange(8)
            elif how == 1:
                mutant[place : place + 8] = rng.choice((b"\xff" * 8, b"\0" * 8, struct.pack("<Q", 2**40)))
            elif how == 2:
                del mutant[place : place + rng.randrange(1, 40)]
            elif how == 3:
                mutant[place:place] = rng.randbytes(rng.randrange(1, 40))
            else:
                mutant[place] = rng.randrange(256)
        file.write_bytes(mutant)
        seen[attempt(file)] += 1
        with contextlib.suppress(HannesError):
            bag_info(file)
    # SQLite has no checksums: what does not change its structure is read as other numbers
    assert kind == "sqlite3" or seen["refused"] > 0


@pytest.mark.parametrize("seed", range(3))
def test_mutated_messages_under_valid_checksums(tmp_path: Path, seed: int) -> None:
    """Damage that no checksum shows: the CDR itself is wrong."""
    rng = random.Random(seed)
    base = motor_messages(STAMPS)
    base["/hannes/stiffness/label"] = (cdr.STRING, [(5, cdr.encode_strings(["soft"])[0])] * 3)
    base["/hannes/stiffness/probability"] = (
        cdr.FLOAT64_MULTI_ARRAY,
        [(5 + k, data) for k, data in enumerate(cdr.encode_multi_arrays(np.ones((9, 3))))],
    )
    for number in range(25):
        messages = {topic: (kind, list(entries)) for topic, (kind, entries) in base.items()}
        for _ in range(rng.randrange(1, 40)):
            _, entries = messages[rng.choice(list(messages))]
            k = rng.randrange(len(entries))
            data = bytearray(entries[k][1])
            place = rng.randrange(len(data))
            data[place : place + 4] = rng.choice((b"\xff" * 4, b"\0" * 4, rng.randbytes(4), b""))
            entries[k] = (entries[k][0], bytes(data))
        attempt(foreign_bag(tmp_path / str(number), messages, StoragePlugin.MCAP))


@pytest.mark.parametrize("seed", range(3))
def test_mutated_metadata(tmp_path: Path, seed: int) -> None:
    file = make("none", tmp_path).parent / "metadata.yaml"
    text = file.read_bytes()
    rng = random.Random(seed)
    for _ in range(30):
        mutant = bytearray(text)
        for _ in range(rng.choice((1, 4, 30))):
            place = rng.randrange(len(mutant))
            mutant[place : place + rng.randrange(3)] = rng.choice(
                (b"[", b"{", b"&a ", b"*a", b"\n", b"!!", b"-", b"\xff", b"9" * 30)
            )
        file.write_bytes(mutant)
        attempt(file.parent)


def record(opcode: int, body: bytes) -> bytes:
    return struct.pack("<BQ", opcode, len(body)) + body


def text(value: str) -> bytes:
    return struct.pack("<I", len(value)) + value.encode()


def chunk(raw: bytes, packed: bytes, name: str, claimed: int) -> bytes:
    body = (
        struct.pack("<QQQI", 0, 1, claimed, zlib.crc32(raw))
        + text(name)
        + struct.pack("<Q", len(packed))
        + packed
    )
    return record(6, body)


def test_lengths_that_lie(tmp_path: Path) -> None:
    """A gigabyte behind a kilobyte, and lengths of 2^60: refused before memory is asked for."""
    head = MAGIC + record(1, text("ros2") + text("x"))
    zeros = b"\0" * (1 << 20)
    bomb = zstandard.ZstdCompressor(level=3).compress(zeros * 512)
    files = {
        "bomb": head + chunk(b"", bomb, "zstd", 100_000),
        "large": head + chunk(b"", bomb, "zstd", 512 << 20),
        "many": head
        + chunk(zeros * 200, zstandard.ZstdCompressor().compress(zeros * 200), "zstd", 200 << 20) * 50,
        "lz4": head + chunk(b"", b"\x04\x22\x4d\x18\x6c\x40" + b"\xff" * 60, "lz4", 2**62),
        "length": head + struct.pack("<BQ", 5, 2**60) + b"\0" * 100,
        "negative": head + struct.pack("<BQ", 5, 2**64 - 1) + b"\0" * 100,
        "nested": head + chunk(b"", chunk(b"", b"", "", 0), "", 65),
    }
    script = (
        "import sys\n"
        "from hannes_bags.reading import read_bag\n"
        "from hannes_description.errors import HannesError\n"
        "for path in sys.argv[1:]:\n"
        "    try:\n"
        "        read_bag(path)\n"
        "    except HannesError as error:\n"
        "        print(error)\n"
        # ru_maxrss is no less than that of the process that started this one
        "print(next(line.split()[1] for line in open('/proc/self/status') if line.startswith('VmHWM')))\n"
    )
    paths = []
    for name, data in files.items():
        (tmp_path / f"{name}.mcap").write_bytes(data)
        paths.append(str(tmp_path / f"{name}.mcap"))
    done = subprocess.run(
        [sys.executable, "-c", script, *paths], capture_output=True, text=True, timeout=PATIENCE
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == len(files) + 1, done.stdout
    assert all("is damaged" in line for line in lines[:-1])
    assert int(lines[-1]) < 1_000_000, "more than 1 GB was used"


def test_recover_survives_mutants(tmp_path: Path) -> None:
    rng = random.Random(7)
    for kind in KINDS:
        folder = tmp_path / kind
        file = make(kind, folder)
        data = file.read_bytes()
        for k in range(25):
            mutant = bytearray(data)
            for _ in range(rng.choice((1, 3))):
                place = rng.randrange(len(mutant))
                mutant[place : place + rng.randrange(9)] = rng.randbytes(rng.randrange(9))
            file.write_bytes(mutant)
            try:
                saved = recover(file, folder / f"out{k}")
            except HannesError:
                continue
            assert bag_info(saved.output).message_count == saved.messages
            assert file.read_bytes() == mutant
