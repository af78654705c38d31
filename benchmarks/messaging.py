"""Measures messages between vehicle and bridge that fly `diffaero_tof` in P02, over UDP.

    python benchmarks/messaging.py [--seeds 4]

This process listens as `lcm-logger` does, and prints for each channel the lost messages, the
latency from a message's `utime` to its arrival, and by how much intervals of regular messages
differ from 20 ms; and the loop from the arrival of an image to that of the velocity setpoint
decided on it. Run it on an idle machine.
"""

import argparse
import collections
import json
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import lcm
import numpy as np
from drake import lcmt_image_array

from splatpilot.analysis.headlines import machine
from splatpilot.systems.messaging import generated

TYPES = {
    "QUADROTOR_STATE": generated.lcmt_quadrotor_state,
    "DEPTH_IMAGE": lcmt_image_array,
    "DEPTH_GRID": generated.lcmt_depth_grid,
    "TRAJECTORY_HYPOTHESES": generated.lcmt_trajectory_hypotheses,
    "BODY_RATE_COMMAND": generated.lcmt_body_rate_command,
    "VELOCITY_SETPOINT": generated.lcmt_velocity_setpoint,
    "BRIDGE_STATUS": generated.lcmt_bridge_status,
}
REGULAR = ("QUADROTOR_STATE", "BODY_RATE_COMMAND", "VELOCITY_SETPOINT")
PERIOD = 20.0  # [ms], of regular messages
PROGRAM = [sys.executable, "-c", "from splatpilot.analysis.commands.main import run; run()"]


@contextmanager
def listening(url: str) -> Iterator[dict[str, list[tuple[int, float, float]]]]:
    """Yields sequence number, utime [s] and arrival [s] of messages, which a thread records."""
    heard, over = collections.defaultdict(list), threading.Event()

    def hear(channel: str, data: bytes) -> None:
        now = time.time()
        stamp = TYPES[channel].decode(data).header
        heard[channel].append((stamp.seq, 1e-6 * stamp.utime, now))

    def listen() -> None:
        while not over.is_set():
            connection.handle_timeout(100)

    connection = lcm.LCM(url)
    for channel in TYPES:
        connection.subscribe(channel, hear).set_queue_capacity(10_000)
    thread = threading.Thread(target=listen)
    thread.start()
    try:
        yield heard
    finally:
        over.set()
        thread.join()


def row(*cells: object) -> None:
    """Prints a row of a Markdown table."""
    print("| " + " | ".join(map(str, cells)) + " |", flush=True)


def fly(options: list[str], folder: Path) -> str:
    """Flies once with two processes, and returns the vehicle's outcome."""
    command = [*PROGRAM, "hardware", "vehicle", *options, "--out", str(folder)]
    vehicle = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    subprocess.run([*PROGRAM, "hardware", "bridge", *options], capture_output=True, check=True)
    if vehicle.wait():
        raise SystemExit("the vehicle failed")
    return json.loads((folder / "summary.json").read_text())["outcome"]


def loop_times(images: np.ndarray, setpoints: np.ndarray) -> np.ndarray:
    """Returns the times [ms] from images to the first setpoints decided after them, of messages
    (n, 3); those are sent between regular ones, with the number of the one before."""
    arrival = setpoints[1:, 2][np.diff(setpoints[:, 0]) == 0]
    last = np.searchsorted(images[:, 2], arrival) - 1
    known, first = np.unique(last, return_index=True)
    return 1e3 * (arrival[first] - images[known, 2])[known >= 0]


def quantiles(parts: list[np.ndarray]) -> tuple[str, ...]:
    values = np.concatenate(parts)
    return tuple(f"{np.quantile(values, q):.2f}" for q in (0.5, 0.99, 1.0))


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=4)
    seeds = parser.parse_args().seeds
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("", 0))
        url = f"udpm://239.255.76.67:{free.getsockname()[1]}?ttl=0&recv_buf_size=4000000"
    options = ["--scenario", "P02", "--policy", "diffaero_tof", "--lcm-url", url]
    options += ["--patience", "120"]
    print(machine())
    outcomes: list[str] = []
    lost = collections.Counter[str]()
    latency, jitter = collections.defaultdict(list), collections.defaultdict(list)
    loops: list[np.ndarray] = []
    with tempfile.TemporaryDirectory() as root:
        for seed in range(seeds):
            with listening(url) as messages:
                outcomes.append(fly([*options, "--seed", str(seed)], Path(root) / str(seed)))
            heard = {name: np.array(values) for name, values in messages.items()}
            first, last = heard["BODY_RATE_COMMAND"][[0, -1], 2]  # while both processes run
            for name, values in heard.items():
                values = values[(values[:, 2] >= first) & (values[:, 2] <= last)]
                numbers, index = np.unique(values[:, 0], return_index=True)
                lost[name] += int(np.ptp(numbers)) + 1 - len(numbers)
                latency[name].append(1e3 * (values[:, 2] - values[:, 1]))
                if name in REGULAR:
                    intervals = 1e3 * np.diff(values[index, 2])
                    jitter[name].append(np.abs(intervals - PERIOD))
            for name in {"DEPTH_IMAGE", "DEPTH_GRID"} & set(heard):
                loops.append(loop_times(heard[name], heard["VELOCITY_SETPOINT"]))
    print(f"{outcomes.count('goal')} of {seeds} flights reached the goal")
    row("[ms]", "messages", "lost", "median", "99 of 100", "maximum")
    row(*["---"] * 6)
    row("image to velocity setpoint", sum(map(len, loops)), "", *quantiles(loops))
    for name, parts in sorted(latency.items()):
        row(f"{name}, latency", sum(map(len, parts)), lost[name], *quantiles(parts))
    for name, parts in jitter.items():
        row(f"{name}, off 20 ms", sum(map(len, parts)), "", *quantiles(parts))


if __name__ == "__main__":
    main()
