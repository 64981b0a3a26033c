"""Seeds that change with the code and are printed, and random machines to try."""

import os
import tempfile
from collections.abc import Callable

import numpy as np
import pytest

from fieldtool.records.model import AxisModel, Coupling, Estimate, MachineModel
from tests.seeds import VARIABLE, fresh_seed, seed_of_run

RandomModel = Callable[..., MachineModel]
seed_of_run()  # before other processes begin, which inherit it
os.environ["FIELDTOOL_STATE_DIR"] = tempfile.mkdtemp(prefix="fieldtool-notes-")
"""Of this process: fixtures of whole modules keep no notes where other test processes see them."""


def _random_model(
    rng: np.random.Generator,
    lengths: tuple[int, ...],
    *,
    damped: bool = True,
    friction: bool = False,
    spread: float = 0.3,
) -> MachineModel:
    """Chains of these lengths, modes between some 2 and 30 Hz, couplings of both signs."""
    chains = []
    for i, n in enumerate(lengths):
        masses = 2.0 * np.exp(rng.uniform(-spread, spread, n))
        springs = 8000.0 * np.exp(rng.uniform(-spread, spread, n - 1))
        dampers = springs * rng.uniform(2e-4, 6e-4, n - 1)
        chains.append(
            AxisModel(
                f"axis{i + 1}",
                "rotary" if i % 2 == 0 else "linear",
                tuple(Estimate(float(m)) for m in masses),
                tuple(Estimate(float(k)) for k in springs),
                tuple(Estimate(float(d)) for d in dampers) if damped else (),
                Estimate(float(rng.uniform(0.1, 1.0)) if friction else 0.0),
                Estimate(float(rng.uniform(0.1, 1.0)) if friction else 0.0),
            )
        )
    couplings = []
    for i in range(len(lengths)):
        for j in range(i + 1, len(lengths)):
            share = rng.uniform(0.15, 0.8) / (len(lengths) - 1) * rng.choice([-1.0, 1.0])
            ends = chains[i].masses[-1].value * chains[j].masses[-1].value
            couplings.append(
                Coupling((chains[i].name, chains[j].name), float(share * np.sqrt(ends)))
            )
    return MachineModel(tuple(chains), tuple(couplings))


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    """Draw the property tests' cases from the run's number too, unless a number of theirs is given."""
    if config.option.hypothesis_seed is None:
        config.option.hypothesis_seed = str(seed_of_run())


def pytest_report_header() -> str:
    """Tell the run's number, which draws the same cases again."""
    return f"{VARIABLE}={seed_of_run()}"


@pytest.fixture(autouse=True)
def _notes_elsewhere(
    monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """Keep notes about unfinished writes out of the user's own state folder."""
    monkeypatch.setenv("FIELDTOOL_STATE_DIR", str(tmp_path_factory.mktemp("notes")))


@pytest.fixture(scope="session")
def random_model() -> RandomModel:
    """Makes ``random_model(rng, lengths, damped=True, friction=False)``."""
    return _random_model


@pytest.fixture
def fresh_rng() -> np.random.Generator:
    """Random numbers of a seed of its own; it is printed, and shown when a test fails."""
    return np.random.default_rng(fresh_seed())
