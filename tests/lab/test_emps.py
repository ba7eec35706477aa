"""The lab on a real machine: the EMPS bench, by its adapter in examples/emps. Skips where the data are not there."""

from pathlib import Path

import numpy as np
import pytest
from hannes_description.errors import HannesError
from hannes_description.model import Model
from hannes_lab.diagnose import effect_sources
from hannes_lab.greedy import grow
from hannes_lab.inverse import force_residual, rows
from hannes_lab.prepare import Prepared, prepare
from hannes_lab.rig import load_rig
from hannes_lab.screen import usable_effects
from hannes_lab.search import Search
from hannes_lab.spectrum import position_periods
from hannes_sim.effect import load_effect


@pytest.fixture(scope="session")
def adapter(repository: Path) -> str:
    return f"{repository / 'examples' / 'emps' / 'emps.py'}:Emps"


@pytest.fixture(scope="session")
def prepared(hannes_data: Path, adapter: str) -> Prepared:
    path = hannes_data / "emps" / "DATA_EMPS.mat"
    if not path.is_file():
        pytest.skip(f"no {path}; set HANNES_DATA to the folder that holds emps/DATA_EMPS.mat")
    rig = load_rig(adapter)
    return prepare(rig.read([path]), Model.load(rig.model), rig=rig)


def test_the_adapter_is_small(adapter: str) -> None:
    assert len(Path(adapter.rpartition(":")[0]).read_text().splitlines()) < 100


def test_a_wrong_file_is_one_clear_error(adapter: str, tmp_path: Path) -> None:
    rig = load_rig(adapter)
    with pytest.raises(HannesError, match=r"DATA_EMPS\.mat"):
        rig.read([tmp_path / "none.mat"])
    wrong = tmp_path / "wrong.mat"
    wrong.write_text("this is no MATLAB file, it only has the ending of one")
    with pytest.raises(HannesError, match="no recording of EMPS"):
        rig.read([wrong])


def test_eight_moves_of_four_laps(prepared: Prepared) -> None:
    trial = prepared.features.trials[0]
    assert len(trial.conditions) == 8
    assert sorted(len(trial.of(c)) for c in trial.conditions) == [3, 3, 4, 4, 4, 4, 4, 4]


def test_nothing_of_a_hand_is_offered(prepared: Prepared) -> None:
    offered = set(usable_effects(prepared, effect_sources(model=prepared.model)).sources)
    assert {
        "coulomb_friction",
        "stribeck_friction",
        "velocity_strengthening",
        "presliding_friction",
        "cogging",
        "command_delay",
    } <= offered
    assert not offered & {
        "wire_slack",
        "wire_elasticity",
        "glove_stiffness",
        "gravity",
        "supply_sag",
        "current_sensor",
    }


def test_coulomb_first_then_the_asymmetry(prepared: Prepared) -> None:
    """Closed-loop errors on moves that took no part in the fit, as they were found for this bench before."""
    names = ("coulomb_friction", "direction_dependent_friction", "cogging")
    search = Search(prepared.problem, prepared.model, prepared.nuisances, {n: n for n in names})
    found = grow(search, search.null(), 2, 0.05)
    assert found.best.names == ("coulomb_friction", "direction_dependent_friction")
    values = found.best.fit.values
    assert values["motor.armature"] == pytest.approx(95.2, abs=0.4)
    assert values["coulomb_friction.level"] == pytest.approx(20.0, rel=0.05)
    assert found.errors == pytest.approx((36.0, 18.4, 6.72), rel=0.05)


def test_the_ripple_of_the_screw_is_in_the_spectrum(prepared: Prepared) -> None:
    names = ("coulomb_friction", "direction_dependent_friction", "stribeck_friction")
    search = Search(prepared.problem, prepared.model, prepared.nuisances, {n: n for n in names})
    best = search.null()
    for name in names:
        best = search.add(best, name)
    periods = position_periods(prepared.problem, best.fit, 1e-3, 0.2)
    assert min(abs(p - 2.5e-3) for p in periods) < 2e-5


def test_inverse_dynamics_needs_no_controller(prepared: Prepared) -> None:
    """The force that mass, viscous and Coulomb friction need for the measured motion, as found before (5.9 N)."""
    trial = prepared.features.trials[0]
    model = prepared.model.with_effect(
        prepared.rig.effect(load_effect("coulomb_friction")).entry({"level": 19.87})
    )
    values = {"motor.armature": 94.96, "friction.viscous": 209.6}
    error = force_residual(prepared.rig, model, values, trial)
    moving = np.logical_or.reduce([rows(trial, c) for c in trial.conditions])
    assert float(np.sqrt(np.mean(error[moving] ** 2))) < 6.0
    without = force_residual(prepared.rig, prepared.model, values, trial)
    assert float(np.sqrt(np.mean(without[moving] ** 2))) > 15.0
