"""How fast and how surely messages travel: vehicle and bridge in processes of their own, over UDP.

    python benchmarks/messaging.py [--scenario P02] [--policy agile_autonomy] [--seeds 20]
        [--set FIELD=VALUE]...

Flies one scenario seed by seed, while this process listens as `lcm-logger` does, and prints

- what was lost: sequence numbers that never came, here and at the bridge;
- latency: from a message's `utime`, when its sender's tick was due, to its arrival here;
- jitter: of what is sent 50 times a second, by how much intervals differ from 20 ms; setpoints
  that are sent between, because they were decided there, are left out;
- the loop: from the arrival of an image to that of the velocity setpoint decided on it;
- how many flights reached the goal, for comparison with `splatpilot benchmark`.

Load counts: run it on an idle machine, or say what else ran. Of virtual machines it prints what
their host took from them meanwhile, where the system tells.
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
from pathlib import Path

import lcm
import numpy as np
from drake import lcmt_header, lcmt_image_array
from harness import header, machine, row

from splatpilot.systems.messaging.generated import (
    lcmt_body_rate_command,
    lcmt_bridge_status,
    lcmt_depth_grid,
    lcmt_quadrotor_state,
    lcmt_trajectory_hypotheses,
    lcmt_velocity_setpoint,
)

TYPES = {
    "QUADROTOR_STATE": lcmt_quadrotor_state,
    "DEPTH_IMAGE": lcmt_image_array,
    "DEPTH_GRID": lcmt_depth_grid,
    "TRAJECTORY_HYPOTHESES": lcmt_trajectory_hypotheses,
    "BODY_RATE_COMMAND": lcmt_body_rate_command,
    "VELOCITY_SETPOINT": lcmt_velocity_setpoint,
    "BRIDGE_STATUS": lcmt_bridge_status,
}
COMMAND_PERIOD = 20.0  # [ms]


class Listener:
    """Takes down what comes, in a thread: sequence numbers, utimes and times of arrival [s]."""

    def __init__(self, url: str):
        self._lcm = lcm.LCM(url)
        self.heard: dict[str, list[tuple[int, float, float]]] = collections.defaultdict(list)
        for channel in TYPES:
            self._lcm.subscribe(channel, self._hear).set_queue_capacity(10_000)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._listen)

    def __enter__(self) -> "Listener":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _listen(self) -> None:
        while not self._over.is_set():
            self._lcm.handle_timeout(100)

    def _hear(self, channel: str, data: bytes) -> None:
        now = time.time()
        stamp: lcmt_header = TYPES[channel].decode(data).header
        self.heard[channel].append((stamp.seq, 1e-6 * stamp.utime, now))


def fly(words: list[str], url: str, folder: Path) -> tuple[str, str, float]:
    """Flies once by two processes; the outcomes of vehicle and bridge, and the bridge's gaps."""
    program = [
        sys.executable,
        "-c",
        "from splatpilot.analysis.commands.main import run; run()",
        "hardware",
    ]
    words = [*words, "--patience", "120", "--lcm-url", url]
    vehicle = subprocess.Popen(
        [*program, "vehicle", *words, "--out", str(folder)],
        stdout=subprocess.PIPE,
        text=True,
    )
    bridge = subprocess.run([*program, "bridge", *words], capture_output=True, text=True)
    vehicle.communicate()
    if bridge.returncode or vehicle.returncode:
        raise SystemExit(f"{' '.join(words)}: {bridge.stderr or 'the vehicle failed'}")
    said = dict(line.split(maxsplit=1) for line in bridge.stdout.splitlines()[-5:])
    summary = json.loads((folder / "summary.json").read_text())
    return summary["outcome"], said["outcome"], float(said["gaps"]) + float(said["rejected"])


def loops(images: np.ndarray, setpoints: np.ndarray) -> np.ndarray:
    """[ms] from images to the first setpoints decided after them, of messages (n, 3) as they were
    heard: those between two of the regular ones, which bear the number of the one before."""
    arrival = setpoints[1:, 2][np.diff(setpoints[:, 0]) == 0]
    last = np.searchsorted(images[:, 2], arrival) - 1
    known, first = np.unique(last, return_index=True)
    return 1e3 * (arrival[first] - images[known, 2])[known >= 0]


def regular(messages: np.ndarray) -> np.ndarray:
    """Of messages (n, 3) the first of each number."""
    return messages[np.unique(messages[:, 0], return_index=True)[1]]


def stolen() -> tuple[float, float]:
    """Time of all cores that a virtual machine's host gave to others, and all time; any unit."""
    stat = Path("/proc/stat")
    if not stat.exists():
        return 0.0, 0.0
    numbers = [float(word) for word in stat.read_text().splitlines()[0].split()[1:9]]
    return numbers[7], sum(numbers)


def quantiles(values: np.ndarray) -> tuple[str, ...]:
    return tuple(f"{np.quantile(values, q):.2f}" for q in (0.5, 0.99, 1.0))


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--scenario", default="P02")
    parser.add_argument("--policy", default="agile_autonomy")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--set", action="append", default=[], help="FIELD=VALUE of the scenario")
    options = parser.parse_args()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as free:
        free.bind(("", 0))
        url = f"udpm://239.255.76.67:{free.getsockname()[1]}?ttl=0&recv_buf_size=4000000"
    print(machine())
    before = stolen()
    outcomes: list[str] = []
    seconds, lost, at_bridge = 0.0, collections.Counter[str](), 0.0
    latency, jitter = collections.defaultdict(list), collections.defaultdict(list)
    looped = []
    with tempfile.TemporaryDirectory() as root:
        for seed in range(options.seeds):
            words = ["--scenario", options.scenario, "--policy", options.policy]
            words += [word for setting in options.set for word in ("--set", setting)]
            with Listener(url) as listener:
                outcome, _, gaps = fly([*words, "--seed", str(seed)], url, Path(root) / str(seed))
            outcomes.append(outcome)
            at_bridge += gaps
            heard = {name: np.array(values) for name, values in listener.heard.items()}
            # While both are there: the vehicle speaks before the bridge does.
            first, last = heard["BODY_RATE_COMMAND"][[0, -1], 2]
            seconds += last - first
            for name, all_of_it in heard.items():
                values = all_of_it[(all_of_it[:, 2] >= first) & (all_of_it[:, 2] <= last)]
                lost[name] += int(np.ptp(values[:, 0])) + 1 - len(np.unique(values[:, 0]))
                latency[name].append(1e3 * (values[:, 2] - values[:, 1]))
                if name in ("QUADROTOR_STATE", "BODY_RATE_COMMAND", "VELOCITY_SETPOINT"):
                    intervals = 1e3 * np.diff(regular(values)[:, 2])
                    jitter[name].append(np.abs(intervals - COMMAND_PERIOD))
            for name in {"DEPTH_IMAGE", "DEPTH_GRID"} & set(heard):
                looped.append(loops(heard[name], heard["VELOCITY_SETPOINT"]))
    print(
        f"\n{options.policy} in {options.scenario}: {outcomes.count('goal')} of {options.seeds} "
        f"reached the goal ({', '.join(outcomes)}); {seconds:.0f} s of messages; the bridge missed "
        f"or rejected {at_bridge:.0f}"
    )
    taken, passed = (after - then for after, then in zip(stolen(), before, strict=True))
    if passed:
        print(f"the host took {100.0 * taken / passed:.1f} % of the machine's time")
    header("channel", "messages", "lost", "latency [ms]: median", "p99", "most",
           "jitter [ms]: median", "p99", "most")  # fmt: skip
    for name, values in sorted(latency.items()):
        delays = np.concatenate(values)
        off = quantiles(np.concatenate(jitter[name])) if jitter[name] else ("", "", "")
        row(name, len(delays), lost[name], *quantiles(delays), *off)
    if looped:
        header("loop [ms]", "median", "p99", "most")
        row("image to velocity setpoint", *quantiles(np.concatenate(looped)))


if __name__ == "__main__":
    main()
