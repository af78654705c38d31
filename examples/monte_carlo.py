"""A Monte Carlo study as a table of pandas.

    python examples/monte_carlo.py --out out/monte_carlo

Flies two policies through the same worlds with and without noise, and computes success, clearance
and the effect of noise. The same command resumes; with more seeds it flies the further ones.
"""

import argparse
from pathlib import Path

import splatpilot as sp

OBSERVATIONS = [
    {"observation.depth_multiplicative": 0.0, "observation.latency": 0.0},
    {"observation.depth_multiplicative": 0.03, "observation.latency": 0.05},
]


def main(out: Path, scenarios: list[str], seeds: int, jobs: int | None) -> None:
    policies = ["reactive", "careful=reactive:margin=0.3"]
    flights = sp.study(scenarios, OBSERVATIONS, policies=policies, seeds=seeds, jobs=jobs, out=out)
    flights["observation"] = [
        "noisy" if each else "clean" for each in flights["observation.latency"]
    ]
    flights["arrived"] = flights.outcome == "goal"
    summary = flights.groupby(["policy", "observation"]).agg(
        flights=("id", "count"),
        success=("arrived", "mean"),
        clearance_p10=("min_clearance_m", lambda clearance: clearance.quantile(0.1)),
        speed=("mean_speed_m_s", "mean"),
    )
    print(summary.round(2).to_string())

    # The same seed is the same world and start: pairs are more precise than means.
    pairs = flights.pivot_table(index=["world_id", "policy"], columns="observation",
                                values="arrived", aggfunc="first")  # fmt: skip
    lost = pairs[pairs.clean.astype(bool) & ~pairs.noisy.astype(bool)]
    print(f"\n{len(lost)} of {len(pairs)} flights arrive without noise and do not with it.")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", type=Path, default=Path("out/monte_carlo"))
    parser.add_argument("--scenarios", nargs="+", default=["P01", "P10"])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--jobs", type=int, help="worker processes; one a core by default")
    main(**vars(parser.parse_args()))
