"""Speed of the node graph in lock-step at 1 kHz control: `python bench/graph.py [--seconds S] [--plant NAME]`.

Times the loop alone (hand_sim and motor_controller) and the whole chain from EMG, as separate processes and composed in
one, beside the same closed loop in process. Prints ratios to real time, and where the time of a tick goes: the plant
and the law (from the rollout), other computing (from the CPU time of the processes), and waiting for messages,
threads and, where other programs run, a core.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import threading
from dataclasses import asdict, dataclass
from pathlib import Path
from time import monotonic, sleep

from hannes_bringup.environment import apply_ros_environment
from hannes_control.double_pid import DoublePID
from hannes_control.reference import half_sine
from hannes_description.model import Model
from hannes_sim.factory import make_plant
from hannes_sim.rollout import rollout

PERIOD = 1e-3
MODULES = {
    "hand_sim": "hannes_sim.sim_node",
    "motor_controller": "hannes_control.motor_controller_node",
    "emg_source": "hannes_control.emg_source_node",
    "emg_reference": "hannes_control.emg_reference_node",
}
LOOP = ("motor_controller", "hand_sim")
CHAIN = ("emg_source", "emg_reference", "motor_controller", "hand_sim")
TARGETS = {
    ("processes", LOOP): 3.0,
    ("processes", CHAIN): 3.0,
    ("composed", LOOP): 8.0,
    ("composed", CHAIN): 8.0,
}


@dataclass(frozen=True)
class Result:
    """One run: simulated time / time; us and us of CPU of a tick; cores that other programs used meanwhile."""

    kind: str
    nodes: str
    ratio: float
    tick_us: float
    cpu_us: float
    other_load: float
    target: float


def cpu_seconds(pid: int) -> float:
    """User and system time of a process, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def busy_seconds() -> float:
    """CPU time of the whole machine that was not idle, s."""
    fields = [int(field) for field in Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:9]]
    return (sum(fields) - fields[3] - fields[4]) / os.sysconf("SC_CLK_TCK")


def in_process(plant: str, seconds: float) -> float:
    """us of a tick of the rollout: plant and law."""
    model = Model.load("nominal").with_plant(plant)
    machine, law = make_plant(model), DoublePID.of_model(model.parameters, PERIOD)
    reference = half_sine(closures=max(1, round(seconds / 4.0)), dt=PERIOD)
    rollout(machine, law, reference[:1000])
    best = float("inf")
    for _ in range(3):
        start = monotonic()
        rollout(machine, law, reference)
        best = min(best, (monotonic() - start) / reference.size)
    return best * 1e6


def graph(kind: str, names: tuple[str, ...], plant: str, seconds: float) -> Result:
    """Run hand_sim and its peers for `seconds` of simulated time."""
    own: dict[str, dict[str, object]] = {
        "hand_sim": {"duration": seconds, "plant": plant, "subscribers": len(names) - 1},
        "motor_controller": (
            {} if "emg_reference" in names else {"reference": "half_sine", "reference_closures": 100}
        ),
        "emg_source": {"closures": 100},
        "emg_reference": {},
    }
    if kind == "composed":
        rules = [f"{name}:{key}:={value}" for name in names for key, value in own[name].items()]
        commands = [
            [
                sys.executable,
                "-m",
                "hannes_bringup.composed_node",
                "--nodes",
                ",".join(names),
                "--ros-args",
                *(part for rule in ("clock:=lockstep", *rules) for part in ("-p", rule)),
            ]
        ]
    else:
        commands = [
            [
                sys.executable,
                "-m",
                MODULES[name],
                "--ros-args",
                *(
                    part
                    for rule in ("clock:=lockstep", *(f"{k}:={v}" for k, v in own[name].items()))
                    for part in ("-p", rule)
                ),
            ]
            for name in names
        ]
    children = [
        subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
        for command in commands
    ]
    lines: list[str] = []
    started, ended = threading.Event(), threading.Event()

    def read(stream: object) -> None:
        for line in stream:  # type: ignore[attr-defined]
            lines.append(line)
            if "starting" in line:
                started.set()
            if "finished" in line:
                ended.set()

    try:
        for child in children:
            threading.Thread(target=read, args=(child.stderr,), daemon=True).start()
        if not started.wait(60.0):
            sys.exit(f"the graph did not start: {''.join(lines)}")
        pids = [child.pid for child in children]
        before, busy_before, start = sum(map(cpu_seconds, pids)), busy_seconds(), monotonic()
        last, last_busy, at = before, busy_before, start
        while not ended.is_set():
            sleep(0.02)
            if children[-1].poll() is not None and not ended.wait(1.0):
                sys.exit(f"the graph ended early: {''.join(lines)}")
            if children[-1].poll() is None:
                last, last_busy, at = sum(map(cpu_seconds, pids)), busy_seconds(), monotonic()
    finally:
        for child in children:
            if child.poll() is None:
                child.send_signal(signal.SIGINT)
        for child in children:
            try:
                child.wait(10.0)
            except subprocess.TimeoutExpired:
                child.kill()
    match = re.search(r"finished .* s in ([0-9.]+) s", "".join(lines))
    assert match is not None, lines
    elapsed = float(match[1])
    tick_us = elapsed / (seconds / PERIOD) * 1e6
    window = max(at - start, 1e-9)
    cores, all_cores = (last - before) / window, (last_busy - busy_before) / window
    return Result(
        kind,
        " + ".join(names),
        seconds / elapsed,
        tick_us,
        cores * tick_us,
        max(0.0, all_cores - cores),
        TARGETS[kind, names],
    )


def limit(result: Result, plant_us: float) -> str:
    """What most of a tick goes into."""
    cores = os.cpu_count() or 1
    floor = result.cpu_us / cores if result.kind == "processes" else result.cpu_us
    parts = {
        "the plant and the law": plant_us,
        "computing in the nodes and the middleware": max(0.0, floor - plant_us),
        "waiting for messages, threads and a free core": max(0.0, result.tick_us - max(floor, plant_us)),
    }
    name = max(parts, key=lambda key: parts[key])
    return f"{name} ({parts[name]:.0f} of {result.tick_us:.0f} us)"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument(
        "--seconds", type=float, default=10.0, help="simulated time of each run with processes"
    )
    parser.add_argument("--plant", default="reduced", help="reduced or mujoco")
    parser.add_argument("--json", action="store_true", help="print the results as JSON")
    arguments = parser.parse_args()
    apply_ros_environment()
    os.environ.setdefault("ROS_DOMAIN_ID", "97")
    with tempfile.TemporaryDirectory() as logs:
        os.environ["ROS_LOG_DIR"] = logs
        plant_us = in_process(arguments.plant, arguments.seconds)
        results = [
            graph(kind, names, arguments.plant, arguments.seconds * (1.0 if kind == "processes" else 2.0))
            for names in (LOOP, CHAIN)
            for kind in ("processes", "composed")
        ]
    if arguments.json:
        print(
            json.dumps(
                {"plant": arguments.plant, "rollout_us": plant_us, "graphs": [asdict(r) for r in results]}
            )
        )
        return
    print(f"lock-step at {1 / PERIOD:.0f} Hz control, plant {arguments.plant}, {os.cpu_count()} cores")
    print(f"  in process     {PERIOD * 1e6 / plant_us:8.1f} x real time  ({plant_us:.1f} us a tick)")
    for result in results:
        verdict = "reached" if result.ratio >= result.target else "NOT reached"
        print(
            f"  {result.kind:<10} {result.ratio:12.1f} x real time  (target {result.target:.0f}, {verdict}; "
            f"{result.tick_us:.0f} us a tick, CPU {result.cpu_us:.0f} us)  {result.nodes}"
        )
        print(
            f"             limited by {limit(result, plant_us)}; others used {result.other_load:.1f} cores meanwhile"
        )


if __name__ == "__main__":
    main()
