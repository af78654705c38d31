"""A Monte Carlo study, read with pandas.

    pip install pandas
    python examples/monte_carlo.py --out out/monte_carlo

Flies two policies through the same worlds with and without noise. From `rollouts.csv`, with a row
per flight, it computes success, clearance and the effect of noise. The same command resumes.
"""

import argparse
from pathlib import Path

import pandas as pd

from splatpilot.analysis.benchmark.run_study import run as fly_study
from splatpilot.analysis.benchmark.study import StudyConfig

NOISE = ["observation.depth_multiplicative=0.03", "observation.latency=0.05"]


def main(out: Path, scenarios: list[str], seeds: int, jobs: int | None) -> None:
    tables = []
    for name, overrides in (("clean", []), ("noisy", NOISE)):
        study = StudyConfig(
            scenarios=scenarios,
            policies=["reactive", "careful=reactive:margin=0.3"],
            seeds=seeds,
            overrides=overrides,
        )
        fly_study(config=study, out=out / name, jobs=jobs)
        tables.append(pd.read_csv(out / name / "rollouts.csv").assign(observation=name))
    flights = pd.concat(tables, ignore_index=True)

    flights["arrived"] = flights.outcome == "goal"
    summary = flights.groupby(["policy", "observation"]).agg(
        flights=("id", "count"),
        success=("arrived", "mean"),
        clearance_p10=("min_clearance_m", lambda clearance: clearance.quantile(0.1)),
        speed=("mean_speed_m_s", "mean"),
    )
    print(summary.round(2).to_string())

    # The same seed is the same world and start: pairs are more precise than means.
    pairs = flights.pivot_table(index=["scenario", "policy", "seed"], columns="observation",
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
