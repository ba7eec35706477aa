#!/usr/bin/env python3
"""Makes the project's Python environment in .venv, and keeps it up to date. Standard library only.

    python3 tools/environment.py            make or update .venv; costs nothing when nothing changed
    python3 tools/environment.py --lock     rewrite requirements/constraints.txt from what .venv holds
    python3 tools/environment.py --rosdep   print the `rosdep install` line for an apt ROS 2

What is installed is declared once, in ros2_ws/src/*/setup.cfg (install_requires), plus requirements/dev.txt;
the versions are pinned in requirements/constraints.txt. Where ROS 2 Jazzy from apt is sourced, its rclpy and
messages are seen through --system-site-packages; elsewhere they are installed as wheels (the extra `wheels`
of hannes_ros). The two are never mixed.

PYTHON=/path/to/python3.12 chooses the interpreter. VENV=DIR chooses another folder than .venv.
"""

from __future__ import annotations

import argparse
import configparser
import contextlib
import fcntl
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
SOURCES = ROOT / "ros2_ws" / "src"
CONSTRAINTS = ROOT / "requirements" / "constraints.txt"
SUPPORTED = ("3.11", "3.12")
APT_PYTHON = "/usr/bin/python3"
STAMP = "hannes-environment.json"
CONSTRAINTS_APT_ROS = ROOT / "requirements" / "constraints-apt-ros.txt"


class SetupError(Exception):
    """Something that the user must put right; the message says how."""


def main() -> int:
    parser = argparse.ArgumentParser(description="Make or update the project's Python environment.")
    parser.add_argument(
        "--lock", action="store_true", help="pin in requirements/constraints.txt what .venv holds"
    )
    parser.add_argument("--rosdep", action="store_true", help="print the rosdep line for an apt ROS 2")
    arguments = parser.parse_args()
    venv = Path(os.environ.get("VENV") or ROOT / ".venv").absolute()
    try:
        if arguments.rosdep:
            print(rosdep_line())
        elif arguments.lock:
            lock(venv)
        else:
            with only_one_at_a_time():
                prepare(venv)
    except SetupError as error:
        print(f"set-up: {error}", file=sys.stderr)
        return 2
    except subprocess.CalledProcessError as error:
        command = " ".join(map(str, error.cmd[:4]))
        print(
            f"set-up: `{command} ...` failed with exit code {error.returncode} (see above)", file=sys.stderr
        )
        return 1
    except KeyboardInterrupt:
        return 130
    return 0


# ---------------------------------------------------------------- making it


def prepare(venv: Path) -> None:
    """Make `venv` hold what the files declare; return at once if its stamp says that it already does."""
    apt_ros = apt_ros_sourced()
    python = venv / "bin" / "python"
    stamp = venv / STAMP
    wanted = fingerprint(apt_ros)
    if python.exists() and stamp.is_file() and json.loads(stamp.read_text()).get("fingerprint") == wanted:
        check_choice(venv)
        return
    started = time.monotonic()
    if not python.exists():
        make_venv(venv, apt_ros)
    check_venv(venv, apt_ros)
    check_choice(venv)
    # colcon would otherwise find the packages of ROS 2 below the environment
    (venv / "COLCON_IGNORE").touch()
    stamp.unlink(missing_ok=True)
    constraints = venv / "hannes-constraints.txt"
    constraints.write_text(constraints_text(apt_ros))
    requirements = venv / "hannes-requirements.txt"
    requirements.write_text("".join(f"{line}\n" for line in requirements_lines(apt_ros)))
    say("installing what the packages require, some minutes the first time ...")
    pip_install(python, "--constraint", str(constraints), "--requirement", str(requirements))
    say("installing the packages of ros2_ws ...")
    editable = [part for package in package_folders() for part in ("--editable", str(package))]
    pip_install(python, "--no-build-isolation", "--no-deps", *editable)
    check_ros(python, apt_ros)
    stamp.write_text(json.dumps({"fingerprint": wanted, "apt_ros": apt_ros}) + "\n")
    say(f"{venv} is ready ({time.monotonic() - started:.0f} s)")


def pip_install(python: Path, *arguments: str) -> None:
    quiet = ["-qq", "--disable-pip-version-check", "--progress-bar", "off"]
    subprocess.run(
        [str(python), "-m", "pip", "install", *quiet, *arguments], check=True, stdin=subprocess.DEVNULL
    )


def make_venv(venv: Path, apt_ros: bool) -> None:
    python = APT_PYTHON if apt_ros and not os.environ.get("PYTHON") else find_python()
    if not runs(python, "import ensurepip, venv"):
        raise SetupError(
            f"{python} cannot make virtual environments: its module ensurepip is missing. On Debian "
            f"and Ubuntu: `apt install python3-venv` (or python{version_of(python)}-venv), then run again."
        )
    say(f"making {venv} with {python}" + (" beside the sourced ROS 2 Jazzy" if apt_ros else ""))
    options = ["--system-site-packages"] if apt_ros else []
    subprocess.run([python, "-m", "venv", *options, str(venv)], check=True, stdin=subprocess.DEVNULL)


def find_python() -> str:
    """PYTHON if given, else the first of python3, python3.12 and python3.11 of a supported version."""
    given = os.environ.get("PYTHON")
    seen = []
    for name in [given] if given else ["python3", "python3.12", "python3.11"]:
        path = shutil.which(name)
        version = version_of(path) if path else None
        if path and version in SUPPORTED:
            return path
        seen.append(
            f"{name}: {'not found' if path is None else f'Python {version}' if version else 'does not run'}"
        )
    raise SetupError(
        f"Python 3.11 or 3.12 is needed, but: {'; '.join(seen)}. Install one (apt install python3 "
        "python3-venv on Debian 12 or Ubuntu 24.04) or name it: `make demo PYTHON=/path/to/python3.12`."
    )


def version_of(python: str | Path) -> str | None:
    """The version as "3.12", or None if it does not run."""
    code = "import sys; print('%d.%d' % sys.version_info[:2])"
    answer = subprocess.run([str(python), "-c", code], capture_output=True, text=True)
    return answer.stdout.strip() if answer.returncode == 0 else None


def runs(python: str | Path, code: str) -> bool:
    return subprocess.run([str(python), "-c", code], capture_output=True).returncode == 0


def check_choice(venv: Path) -> None:
    """PYTHON was given: the environment must be of that version."""
    given = os.environ.get("PYTHON")
    if given and version_of(find_python()) != (now := version_of(venv / "bin" / "python")):
        raise SetupError(f"{venv} is of Python {now}, not of {given}. Remove it first (`make distclean`).")


def check_venv(venv: Path, apt_ros: bool) -> None:
    """Refuse an environment of another Python or of the other kind of ROS."""
    python = venv / "bin" / "python"
    if version_of(python) not in SUPPORTED:
        raise SetupError(
            f"{python} is not a working Python 3.11 or 3.12. Remove {venv} first (`make distclean`)."
        )
    settings = (venv / "pyvenv.cfg").read_text() if (venv / "pyvenv.cfg").is_file() else ""
    sees_system = bool(re.search(r"^include-system-site-packages\s*=\s*true", settings, re.MULTILINE))
    if sees_system != apt_ros:
        now = "ROS 2 Jazzy from apt is sourced" if apt_ros else "no ROS 2 is sourced"
        was = "beside an apt ROS 2" if sees_system else "with ROS 2 from wheels"
        shell = "open a shell without ROS" if apt_ros else "source /opt/ros/jazzy/setup.bash"
        raise SetupError(
            f"{venv} was made {was}, but now {now}. The two are never mixed: {shell}, or remove {venv} "
            "(`make distclean`)."
        )


def check_ros(python: Path, apt_ros: bool) -> None:
    """Import what the nodes need, so that a broken ROS 2 is found here and not in the middle of a run."""
    names = "rclpy, std_msgs.msg, sensor_msgs.msg, diagnostic_msgs.msg, rosgraph_msgs.msg"
    answer = subprocess.run([str(python), "-c", f"import {names}"], capture_output=True, text=True)
    if answer.returncode:
        hint = (
            "install ros-jazzy-ros-base"
            if apt_ros
            else "its wheels are for x86-64 Linux with glibc 2.28 or newer; elsewhere source ROS 2 Jazzy"
        )
        raise SetupError(f"ROS 2 cannot be imported ({last_line(answer.stderr)}): {hint}.")


def apt_ros_sourced() -> bool:
    """True if ROS 2 Jazzy from apt is sourced. Another distribution is an error."""
    distribution = os.environ.get("ROS_DISTRO")
    if not distribution:
        return False
    if distribution != "jazzy":
        raise SetupError(
            f"ROS 2 {distribution} is sourced, but this project is for Jazzy. Open a shell without it, or "
            "source Jazzy."
        )
    python = os.environ.get("PYTHON") or APT_PYTHON
    if not runs(python, "import rclpy"):
        raise SetupError(
            f"ROS_DISTRO=jazzy is set, but {python} cannot import rclpy. Source /opt/ros/jazzy/setup.bash, "
            "or unset ROS_DISTRO to use the wheels."
        )
    return True


@contextlib.contextmanager
def only_one_at_a_time() -> Iterator[None]:
    """Hold a lock on the project's folder: two `make` at once would install into one environment."""
    folder = os.open(ROOT, os.O_RDONLY)
    try:
        fcntl.flock(folder, fcntl.LOCK_EX)
        yield
    finally:
        os.close(folder)


# ---------------------------------------------------------------- what is declared


def package_folders() -> list[Path]:
    return sorted(path.parent for path in SOURCES.glob("*/setup.cfg"))


def declared(package: Path) -> tuple[list[str], dict[str, list[str]]]:
    """install_requires and extras_require of one package's setup.cfg."""
    config = configparser.ConfigParser(interpolation=None)
    config.read(package / "setup.cfg", encoding="utf-8")
    section = "options.extras_require"
    extras = dict(config[section]) if config.has_section(section) else {}
    required = lines(config.get("options", "install_requires", fallback=""))
    return required, {name: lines(text) for name, text in extras.items()}


def lines(text: str) -> list[str]:
    """The requirements in a text, one a line, without comments."""
    stripped = (line.split("#")[0].strip() for line in text.splitlines())
    return [line for line in stripped if line]


def requirements_lines(apt_ros: bool) -> list[str]:
    """Every requirement of the project from outside it, sorted."""
    own = {package.name for package in package_folders()}
    found: set[str] = set(lines((ROOT / "requirements" / "dev.txt").read_text()))
    if not apt_ros:
        for name in ("colcon.txt", "bench.txt"):
            found.update(lines((ROOT / "requirements" / name).read_text()))
    for package in package_folders():
        required, extras = declared(package)
        found.update(line for line in required if line not in own)
        if not apt_ros:
            found.update(extras.get("wheels", []))
    return sorted(found, key=str.lower)


def constraints_text(apt_ros: bool) -> str:
    """The pins, with those of constraints-apt-ros.txt in place of their namesakes beside an apt ROS."""
    pins = dict(line.split("==") for line in lines(CONSTRAINTS.read_text()))
    if apt_ros:
        pins |= dict(line.split("==") for line in lines(CONSTRAINTS_APT_ROS.read_text()))
    return "".join(f"{name}=={version}\n" for name, version in pins.items())


def fingerprint(apt_ros: bool) -> str:
    """A hash of everything that decides what the environment holds, this file included."""
    digest = hashlib.sha256(f"{ROOT} {apt_ros}".encode())
    files = [Path(__file__).resolve(), *sorted((ROOT / "requirements").glob("*.txt"))]
    for package in package_folders():
        files += [package / "setup.cfg", package / "pyproject.toml"]
    for file in files:
        digest.update(file.read_bytes())
    return digest.hexdigest()


# ---------------------------------------------------------------- the other two commands

LOCK_HEADER = """\
# Every version that the project is tested with, on Python 3.11 and 3.12. `make lock` writes this file.
"""

CLOSURE = """
import importlib.metadata as metadata, json, re, sys
def canonical(name): return re.sub(r"[-_.]+", "-", name).lower()
from pip._vendor.packaging.requirements import Requirement
todo, seen = [Requirement(line) for line in json.load(sys.stdin)], {}
done = set()
while todo:
    requirement = todo.pop()
    key = (canonical(requirement.name), frozenset(requirement.extras))
    if key in done:
        continue
    done.add(key)
    distribution = metadata.distribution(requirement.name)
    seen[canonical(requirement.name)] = distribution.version
    for text in distribution.requires or []:
        child = Requirement(text)
        extras = requirement.extras or {""}
        if child.marker is None or any(child.marker.evaluate({"extra": extra}) for extra in extras):
            todo.append(child)
json.dump(seen, sys.stdout)
"""


def lock(venv: Path) -> None:
    """Pin what `venv` holds of the requirements and of everything that they require."""
    asked = json.dumps(requirements_lines(apt_ros=False))
    command = [str(venv / "bin" / "python"), "-c", CLOSURE]
    answer = subprocess.run(command, input=asked, capture_output=True, text=True)
    if answer.returncode:
        raise SetupError(f"{venv} does not hold all requirements: {last_line(answer.stderr)}")
    pins = json.loads(answer.stdout)
    CONSTRAINTS.write_text(LOCK_HEADER + "".join(f"{name}=={pins[name]}\n" for name in sorted(pins)))
    say(f"{len(pins)} versions pinned in {CONSTRAINTS.relative_to(ROOT)}")


def rosdep_line() -> str:
    """The line that installs what apt has.

    Keys that end in -pip are left to .venv: Ubuntu's Python takes no pip packages of its own (PEP 668).
    """
    keys = {
        element.text
        for file in SOURCES.glob("*/package.xml")
        for element in ElementTree.parse(file).getroot()
        if element.tag.endswith("depend") and element.text and element.text.endswith("-pip")
    }
    skipped = " ".join(sorted(filter(None, keys)))
    return (
        f'rosdep install --from-paths ros2_ws/src --ignore-src --rosdistro jazzy -y --skip-keys "{skipped}"'
    )


def last_line(text: str) -> str:
    return (text.strip().splitlines() or ["no message"])[-1]


def say(text: str) -> None:
    print(f"set-up: {text}", file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
