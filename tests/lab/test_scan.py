"""What a scan of the strengths and shapes of an effect hands to the fits."""

from hannes_lab.scan import _distinct


def test_of_points_of_one_period_the_best_stays_in_its_place() -> None:
    scored = [(float(cost), {"period": period}) for cost, period in enumerate((2.0, 3.0, 2.0, 5.0, 3.0))]
    assert _distinct(scored, "period") == [scored[0], scored[1], scored[3]]
