"""How often the intervals of `hannes calibrate` hold the truth, on hands drawn from the population.

    python bench/coverage.py [--hands 30] [--free friction.coulomb,hand.preload,motor.kt]

Each hand differs from the nominal one in all that population.yaml speaks of; only the free parameters are identified.
"""

from __future__ import annotations

import argparse
import math

from hannes_description.model import Model
from hannes_lab.calibrate import LARGE_MISFIT, calibrate
from hannes_lab.hide import make_set
from hannes_lab.prepare import prepare
from hannes_lab.recorded import make_trial
from hannes_lab.trials import unique_names


def main() -> None:
    """Print one line per hand and the share of intervals that hold the truth."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hands", type=int, default=30)
    parser.add_argument("--seed", type=int, default=1010, help="of the first hand")
    parser.add_argument("--free", default="friction.coulomb,hand.preload,motor.kt")
    given = parser.parse_args()
    nominal = Model.load("nominal")
    names = given.free.split(",")
    rows: list[tuple[bool, bool, bool]] = []
    for seed in range(given.seed, given.seed + given.hands):
        recordings, truth = make_set(nominal, [], seed=seed, closures=6)
        found = calibrate(
            prepare(unique_names([make_trial(r) for r in recordings]), nominal), names, starts=1
        )
        explained = found.errors["after"] <= LARGE_MISFIT
        text: list[str] = []
        for p in found.parameters:
            true = nominal.parameters.value(p.name) * float(truth.parameters[p.name].split()[1])
            exact = 0.5 * math.log(p.high / p.low) * math.sqrt(max(0.0, 1.0 - p.held_share))
            rows.append((p.low <= true <= p.high, abs(math.log(p.value / true)) <= exact, explained))
            text.append(
                f"{p.name} {p.value / true:.3f} of the truth, 95 % {p.low / true:.3f} .. {p.high / true:.3f}"
            )
        print(
            f"hand {seed}, error {found.errors['after']:.1f} x repeatability: {'; '.join(text)}", flush=True
        )
    for title, part in (
        ("all", rows),
        (f"where the error is at most {LARGE_MISFIT:g} x repeatability", [r for r in rows if r[2]]),
    ):
        if part:
            print(
                f"{title}: {sum(r[0] for r in part)} of {len(part)} intervals hold the truth; "
                f"{sum(r[1] for r in part)} with the most important held parameter taken as exact"
            )


if __name__ == "__main__":
    main()
