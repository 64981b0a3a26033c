"""Criticism beside other people's methods on the same recordings: what is left, and what each can say.

A machine is drawn and something is hidden in it, as in ``bench_hidden.py``.  All get the same: the
torque that the machine without effects, fitted to the same rows, leaves unexplained, and position,
velocity and acceleration of every axis.  They learn from the same experiments and are judged on the
same ones that nobody has seen, by the same measure: RMS of the error in the band over RMS of the torque.

- sparse regression: ``pysindy``'s sequentially thresholded least squares over some thirty terms (sign,
  square and tanh of the velocity; powers of the motion; sines of the position).  The threshold is the
  one that does best on a part of the seen rows that it was not given.
- boosted trees: scikit-learn's ``HistGradientBoostingRegressor`` on the motion at five times.
- lags: a linear model (ridge) of 41 past and following samples of all positions, as a small NARX has.

Run: python tests/benchmarks/bench_hidden_peers.py [EFFECT ...] [seed=SEED]
Wants the extra ``benchmarks``; a peer that is missing is said to be.
"""

import os
import sys
import time
from importlib.util import find_spec
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from bench_hidden import told

from fieldtool.criticise.criticise import criticise
from fieldtool.criticise.where.sentences import relative_error, relative_noise
from tests.hidden.hiding import draw

EFFECTS = (
    "coulomb_friction", "stribeck_friction", "backlash", "hardening_spring", "cogging",
    "measurement_delay", "torque_scale", "torque_saturation",
)  # fmt: skip
CLEAR = 30.0
"""Times the noise floor."""
EVERY = 3
"""Rows that peers learn from: one of so many."""
LAGS = 20
"""Samples to either side."""
THRESHOLDS = np.geomspace(0.01, 1.0, 9)
"""Of the size that a term has, over that of the error."""


class Data:
    """What all peers get of one case."""

    def __init__(self, case):
        model = case.machine.model
        self.criticised = criticise(case.recording, model, model)
        found = self.criticised.found
        self.prepared, self.before = found.prepared, found.before.hypothesis
        self.simulator = self.prepared.simulator
        self.errors = self.simulator.errors(self.before)
        self.axes = len(case.recording.axes)
        self.roles = {s.experiment: s.role for s in self.prepared.spans.spans}

    def seen(self):
        """Motions and errors to learn from."""
        return [
            (self.prepared.motions[name], self.errors[name])
            for name, role in self.roles.items()
            if role == "fit"
        ]

    def left(self, predict):
        """Relative error on what nobody has seen, where a peer predicts the error (n, M)."""
        parts = []
        for lines in self.simulator.lines:
            if lines.span.role != "unseen":
                continue
            name = lines.span.experiment
            error = self.errors[name] - predict(self.prepared.motions[name])
            parts.append((lines, lines.projected(lines.weighted(error))))
        return overall([relative_error(parts, k) for k in range(self.axes)])


def overall(errors):
    """One number for all axes."""
    return float(np.sqrt(np.mean(np.square(errors))))


def state(motion):
    """Position, velocity, acceleration of all axes, (n, 3 M), low-passed where they are noisy."""
    acceleration = np.gradient(motion.smooth_velocity, motion.step, axis=0)
    return np.hstack([motion.smooth_position, motion.smooth_velocity, acceleration])


def terms(motion, axis):
    """Terms of a sparse regression for one axis, (n, P), and their names."""
    q, v = motion.smooth_position, motion.smooth_velocity
    a = np.gradient(v, motion.step, axis=0)
    mine = v[:, axis]
    fast = np.std(mine)
    columns = {
        "sign(v)": np.sign(mine), "v |v|": mine * np.abs(mine), "tanh(5 v/v0)": np.tanh(5 * mine / fast),
        "1": np.ones_like(mine), "sin q": np.sin(q[:, axis]), "cos q": np.cos(q[:, axis]),
    }  # fmt: skip
    for order in (8, 12, 16, 18, 24):
        columns[f"sin {order} q"] = np.sin(order * q[:, axis])
        columns[f"cos {order} q"] = np.cos(order * q[:, axis])
    for k in range(q.shape[1]):
        who = "" if q.shape[1] == 1 else f"{k + 1}"
        columns |= {
            f"q{who}": q[:, k], f"v{who}": v[:, k], f"a{who}": a[:, k],
            f"q{who}^3": q[:, k] ** 3, f"v{who}^3": v[:, k] ** 3, f"a{who}^3": a[:, k] ** 3,
            f"jerk{who}": np.gradient(a[:, k], motion.step),
        }  # fmt: skip
    return np.column_stack(list(columns.values())), list(columns)


def sparse(data):
    """Sparse regression; its prediction, and its terms in words."""
    from pysindy import STLSQ

    models, words = [], []
    for axis in range(data.axes):
        rows, sides = [], []
        for motion, error in data.seen():
            counted = np.flatnonzero(motion.counted[:, axis])[::EVERY]
            rows.append(terms(motion, axis)[0][counted])
            sides.append(error[counted, axis])
        A, b, names = np.vstack(rows), np.concatenate(sides), terms(data.seen()[0][0], axis)[1]
        scale, size = np.std(A, axis=0) + (np.std(A, axis=0) == 0), np.std(b)
        held = (np.arange(b.size) // 500) % 4 == 3
        best = None
        for threshold in THRESHOLDS:
            fitted = STLSQ(threshold=threshold, alpha=1e-6, normalize_columns=False)
            fitted.fit(A[~held] / scale, b[~held, None] / size)
            weights = np.ravel(fitted.coef_)
            missed = np.sum((b[held] / size - A[held] / scale @ weights) ** 2)
            if best is None or missed < best[0]:
                best = missed, weights * size / scale, weights
        models.append(best[1])
        order = np.argsort(-np.abs(best[2]))
        said = [f"{best[1][k]:+.3g} {names[k]}" for k in order if best[2][k] != 0.0]
        words.append(f"axis{axis + 1}: {' '.join(said[:4])} ({len(said)} terms)")
    return (
        lambda motion: np.column_stack([terms(motion, k)[0] @ w for k, w in enumerate(models)]),
        "; ".join(words),
    )


def boosted(data):
    """Boosted trees over the motion at five times."""
    from sklearn.ensemble import HistGradientBoostingRegressor

    def features(motion):
        now = state(motion)
        return np.hstack([np.roll(now, shift, axis=0) for shift in (-10, -3, 0, 3, 10)])

    models = []
    for axis in range(data.axes):
        rows, sides = [], []
        for motion, error in data.seen():
            counted = np.flatnonzero(motion.counted[:, axis])[::EVERY]
            rows.append(features(motion)[counted])
            sides.append(error[counted, axis])
        trees = HistGradientBoostingRegressor(max_iter=150, learning_rate=0.1, random_state=0)
        models.append(trees.fit(np.vstack(rows), np.concatenate(sides)))
    return (
        lambda motion: np.column_stack([m.predict(features(motion)) for m in models]),
        "nothing: 150 trees",
    )


def lagged(data):
    """Linear in the positions around a sample."""
    from sklearn.linear_model import RidgeCV
    from sklearn.preprocessing import StandardScaler

    def features(motion):
        shifts = range(-LAGS, LAGS + 1)
        return np.hstack([np.roll(motion.position, -s, axis=0) for s in shifts])

    models = []
    for axis in range(data.axes):
        rows, sides = [], []
        for motion, error in data.seen():
            counted = np.flatnonzero(motion.counted[:, axis])[::EVERY]
            rows.append(features(motion)[counted])
            sides.append(error[counted, axis])
        scaler = StandardScaler().fit(np.vstack(rows))
        ridge = RidgeCV(np.geomspace(1e-6, 1e6, 13)).fit(
            scaler.transform(np.vstack(rows)), np.concatenate(sides)
        )
        models.append((scaler, ridge))
    return (
        lambda motion: np.column_stack(
            [r.predict(s.transform(features(motion))) for s, r in models]
        ),
        f"nothing: {2 * LAGS + 1} weights a position",
    )


PEERS = {
    "sparse regression": ("pysindy", sparse),
    "boosted trees": ("sklearn", boosted),
    "lags": ("sklearn", lagged),
}


def said(criticism):
    """Causes with their numbers, in words."""
    out = []
    for c in criticism.causes:
        numbers = ", ".join(
            f"{k} {n.value:.3g} +- {n.std:.1g} {n.unit}" for k, n in c.parameters.items()
        )
        ties = "".join(f" (or {t.effect}: {t.experiment})" for t in c.ties)
        out.append(f"{c.effect} of {c.axis_words}, {c.location}: {numbers}{ties}")
    return "; ".join(out) or criticism.verdict


def main():
    """One table a case."""
    words = dict(w.split("=", 1) for w in sys.argv[1:] if "=" in w)
    effects = tuple(w for w in sys.argv[1:] if "=" not in w) or EFFECTS
    seed = int(words.get("seed", 0)) or int(np.random.SeedSequence().entropy % 2**31)
    print(f"seed {seed}")
    sums = {}
    for number, effect in enumerate(effects):
        case = draw(seed + 7919 * number, (effect,), CLEAR)
        hidden = case.hidden[0]
        begin = time.process_time()
        data = Data(case)
        seconds = time.process_time() - begin
        held = data.criticised.criticism.held_out
        parts = data.simulator.parts(data.before, "unseen")
        noise = [relative_noise(parts, k) or 0.0 for k in range(data.axes)]
        structure = told(data.criticised, hidden)
        rows = [
            ("machine alone", overall([e.torque for e in held.error_before.values()]), "", 0.0),
            ("criticism", overall([e.torque for e in held.error_after.values()]),
             said(data.criticised.criticism), seconds),
            ("told the structure", overall(structure) if structure else np.nan, "", 0.0),
            ("noise", overall(noise), "", 0.0),
        ]  # fmt: skip
        for name, (package, learn) in PEERS.items():
            if find_spec(package) is None:
                rows.append((name, np.nan, f"{package} is not installed", 0.0))
                continue
            begin = time.process_time()
            predict, what = learn(data)
            rows.append((name, data.left(predict), what, time.process_time() - begin))
        print(
            f"\n{effect} of axis{hidden.axis + 1}, {hidden.visibility:.0f} times the noise:",
            hidden.part,
        )
        for name, error, what, spent in rows:
            print(f"  {name:20} {100 * error:7.3f} %  {spent:5.1f} s  {what}")
            sums.setdefault(name, []).append(error / max(rows[0][1], 1e-300))
    print(
        f"\nerror on unseen data over that of the machine alone, geometric mean of {len(effects)} cases"
    )
    for name, shares in sums.items():
        good = [s for s in shares if np.isfinite(s)]
        print(f"  {name:20} {np.exp(np.mean(np.log(good))):7.3f}" if good else f"  {name:20} -")


if __name__ == "__main__":
    main()
