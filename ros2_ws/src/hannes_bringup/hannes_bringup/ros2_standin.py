"""`hannes_ros2 run` and `hannes_ros2 launch`: what `ros2 run` and `ros2 launch` do, where there is no ros2.

The wheels of ROS 2 hold rclpy but not the `ros2` command. `run` looks for an executable as `ros2 run` does, in
lib/PACKAGE of each prefix on AMENT_PREFIX_PATH, and then in what is installed in this Python environment.
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
from collections.abc import Mapping, Sequence
from importlib import metadata, resources
from pathlib import Path

from hannes_description.errors import HannesError

from .environment import ros_environment
from .launch_file import LaunchPlan, read_launch_file
from .processes import QUIET_FROM_THE_START, Interrupted, ProcessGroup, raise_on_signals


def prefixes(environment: Mapping[str, str]) -> list[Path]:
    """The prefixes of the ament index, first overlay first."""
    return [Path(part) for part in environment.get("AMENT_PREFIX_PATH", "").split(os.pathsep) if part]


def has_real_ros2(environment: Mapping[str, str]) -> bool:
    """True if `ros2 launch` is there and knows our packages (a sourced colcon workspace)."""
    index = Path("share") / "ament_index" / "resource_index" / "packages" / "hannes_bringup"
    return shutil.which("ros2") is not None and any(
        (prefix / index).exists() for prefix in prefixes(environment)
    )


def find_command(package: str, executable: str, environment: Mapping[str, str]) -> list[str]:
    """The command that runs an executable of a package; HannesError lists the valid ones."""
    found: set[str] = set()
    for prefix in prefixes(environment):
        folder = prefix / "lib" / package
        for file in sorted(folder.rglob("*")) if folder.is_dir() else ():
            if file.is_file() and os.access(file, os.X_OK):
                if file.name == executable:
                    return [str(file)]
                found.add(file.name)
    for entry in _entry_points(package):
        if entry.name == executable:
            module, _, function = entry.value.partition(":")
            code = (
                f"{QUIET_FROM_THE_START}"
                f"sys.argv[0] = {executable!r}\n"
                f"from {module} import {function}\n"
                f"sys.exit({function}())"
            )
            return [sys.executable, "-c", code]
        found.add(entry.name)
    if found:
        raise HannesError(
            f"Package '{package}' has no executable '{executable}'; valid are {', '.join(sorted(found))}."
        )
    raise HannesError(
        f"No package '{package}' with executables is installed. Run `make setup`, or build the workspace and "
        "`source ros2_ws/install/setup.bash`."
    )


def _entry_points(package: str) -> list[metadata.EntryPoint]:
    try:
        distribution = metadata.distribution(package)
    except metadata.PackageNotFoundError:
        return []
    return sorted(distribution.entry_points.select(group="console_scripts"), key=lambda entry: entry.name)


def share_folder(package: str, environment: Mapping[str, str]) -> Path:
    """Where launch/ and config/ of a package are: its share folder, or the Python package itself under pip."""
    for prefix in prefixes(environment):
        if (prefix / "share" / "ament_index" / "resource_index" / "packages" / package).exists():
            return prefix / "share" / package
    try:
        return Path(str(resources.files(package)))
    except ModuleNotFoundError:
        raise HannesError(
            f"Package '{package}' is not installed; known prefixes are {prefixes(environment)}."
        ) from None


def launch(plan: LaunchPlan, environment: Mapping[str, str]) -> int:
    """Start the nodes of a plan; wait until all or a required one ended, one failed, or SIGINT or SIGTERM comes.

    All are stopped then. Returns 0 if every node ended with 0, else 1.
    """
    commands = [
        (node.name, [*find_command(node.package, node.executable, environment), *node.arguments])
        for node in plan.nodes
    ]
    required = {node.name for node in plan.nodes if node.required}
    raise_on_signals()
    group = ProcessGroup(lambda text: print(text, file=sys.stderr, flush=True), environment)
    try:
        with group:
            for name, command in commands:
                group.start(name, command)
            group.wait(lambda codes: any(codes.values()) or not required.isdisjoint(codes))
    except Interrupted:
        # the signal may have come while a failure was being cleaned up; it is ignored from now on
        group.stop()
    return int(any(group.exit_codes.values()))


def parse_launch_arguments(words: Sequence[str]) -> dict[str, str]:
    """`["clock:=lockstep"]` -> {"clock": "lockstep"}."""
    given = {}
    for word in words:
        name, separator, value = word.partition(":=")
        if not separator or not name:
            raise HannesError(f"'{word}' is not an argument of a launch file; write name:=value.")
        given[name] = value
    return given


def launch_path(package: str, file: str, environment: Mapping[str, str]) -> Path:
    """The launch file of that name in a package's share/PACKAGE/launch."""
    folder = share_folder(package, environment) / "launch"
    path = folder / file
    if not path.is_file():
        names = sorted(item.name for item in folder.glob("*.launch.yaml"))
        raise HannesError(
            f"Package '{package}' has no launch file '{file}'; valid are {', '.join(names) or 'none'}."
        )
    if path.suffix not in (".yaml", ".yml"):
        raise HannesError(f"'{file}' needs the real `ros2 launch`; here only *.launch.yaml files run.")
    return path


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point of `hannes_ros2`."""
    parser = argparse.ArgumentParser(
        prog="hannes_ros2", description="ros2 run and ros2 launch where there is no ros2."
    )
    verbs = parser.add_subparsers(dest="verb", required=True)
    run = verbs.add_parser("run", help="run an executable of a package")
    run.add_argument("package")
    run.add_argument("executable")
    run.add_argument("arguments", nargs=argparse.REMAINDER)
    start = verbs.add_parser("launch", help="start the nodes of a launch file")
    start.add_argument("package")
    start.add_argument("file")
    start.add_argument("arguments", nargs="*", metavar="name:=value")
    options = parser.parse_args(arguments)
    environment = ros_environment()
    try:
        if options.verb == "run":
            command = find_command(options.package, options.executable, environment)
            os.execve(command[0], [*command, *options.arguments], environment)
        path = launch_path(options.package, options.file, environment)
        plan = read_launch_file(
            path,
            parse_launch_arguments(options.arguments),
            lambda package: share_folder(package, environment),
        )
        return launch(plan, environment)
    except HannesError as error:
        print(f"hannes_ros2: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
