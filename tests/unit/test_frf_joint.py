"""The open-loop response matrix from closed-loop multisines, against simulated machines."""

import re
from dataclasses import dataclass, replace

import numpy as np
import pytest

from fieldtool.errors import NotEnoughDataError
from fieldtool.frf.held_targets import LINEAR_TARGETS, folded_phasors, held_offset
from fieldtool.frf.multisine.inputs import check_saturation
from fieldtool.frf.multisine.matrix import joint_response
from fieldtool.frf.multisine.period import find_period, whole_periods
from fieldtool.identify.likelihood.refine import machine_response
from fieldtool.records.closed_loop import AxisLoop, ClosedLoop
from fieldtool.records.recorded import AxisInfo, Controller, Experiment, Recording

STEP = 0.002
FINE = 8
PERIOD = 2.0
NOISE = (2e-7, 2e-7, 0.01, 0.01)


def odd_lines(rng, top=50):
    """Odd lines, one of every four left out at random for detection."""
    lines = np.arange(1, top, 2)
    left_out = np.arange(1, lines.size - 4, 4) + rng.integers(0, 3, lines[1:-4:4].size)
    return np.delete(lines, left_out)


def random_loops(rng, model):
    """Stable loops of both axes, each a different one."""
    while True:
        loops = tuple(
            AxisLoop(
                rng.uniform(4, 12), axis.total_mass * rng.uniform(8, 20), rng.uniform(0, 60), 0.0
            )
            for axis in model.axes
        )
        closed = ClosedLoop(model, loops)
        if closed.stable and np.max(np.linalg.eigvals(closed.system_matrix()).real) < -0.3:
            return closed


@dataclass
class Bench:
    """A machine with two axes under its loops, and what was measured on it without noise."""

    closed: ClosedLoop
    lines: np.ndarray
    references: list
    """(rows, 2) each, at the fine step."""

    @classmethod
    def make(cls, rng, model, *, realisations=1, levels=(1.0,), settle=1.0, periods=2, lines=None):
        lines = odd_lines(rng) if lines is None else lines
        rows = round((settle + periods * PERIOD) / STEP) * FINE
        time = (np.arange(rows) - round(settle / STEP) * FINE) * STEP / FINE
        waves = np.exp(2j * np.pi * np.outer(time, lines / PERIOD))
        references = []
        for _ in range(realisations):
            phases = np.exp(2j * np.pi * rng.random((lines.size, 2)))
            size = 0.01 / np.maximum(lines / PERIOD, 2)[:, None]
            signs = (np.array([1, 1]), np.array([1, -1]))
            references += [
                level * np.real(waves @ (phases * size * sign))
                for level in levels
                for sign in signs
            ]
        return cls(random_loops(rng, model), lines, references)

    def record(self, noise=None, rng=None, feedback=0.0):
        """Return the recording; ``feedback`` is encoder noise that the loops see as well, rad."""
        names = self.closed.model.names
        experiments = []
        for number, reference in enumerate(self.references):
            position, torque = self.closed.simulate(reference, STEP / FINE)
            position, torque = position[::FINE].copy(), torque[::FINE].copy()
            if noise is not None:
                position += np.array(noise[:2]) * rng.normal(size=position.shape)
                torque += np.array(noise[2:]) * rng.normal(size=torque.shape)
            experiments.append(
                Experiment(
                    f"m{number + 1}",
                    "multisine",
                    names,
                    (),
                    PERIOD,
                    np.arange(len(position)) * STEP,
                    position,
                    torque,
                    position_reference=reference[::FINE],
                )
            )
        axes = tuple(AxisInfo(axis.name, "rotary") for axis in self.closed.model.axes)
        return Recording(STEP, axes, tuple(experiments))


def with_noise(recording, rng, noise=NOISE):
    """Add white noise to a recording."""
    experiments = [
        replace(
            one,
            position=one.position + np.array(noise[:2]) * rng.normal(size=one.position.shape),
            torque=one.torque + np.array(noise[2:]) * rng.normal(size=one.torque.shape),
        )
        for one in recording.experiments
    ]
    return replace(recording, experiments=tuple(experiments))


def relative(G, truth):
    size = np.sqrt(np.abs(np.einsum("fii->fi", truth)))
    return np.abs(G - truth) / (size[:, :, None] * size[:, None, :])


def changed(recording, number, **changes):
    """Replace parts of one experiment."""
    experiments = list(recording.experiments)
    experiments[number] = replace(experiments[number], **changes)
    return replace(recording, experiments=tuple(experiments))


def test_any_controllers_give_the_same_open_loop_matrix(fresh_rng, random_model):
    model = random_model(fresh_rng, (2, 3), friction=True)
    for _ in range(2):
        bench = Bench.make(fresh_rng, model)
        found = joint_response(bench.record())
        assert np.array_equal(np.round(found.response.frequencies * PERIOD), bench.lines)
        truth = machine_response(model, 2 * np.pi * found.response.frequencies)
        # The references' corners between fine samples are in the sampled torque: (w T / 8)^2 / 12.
        assert np.median(relative(found.response.response, truth)) < 1e-4
        assert relative(found.response.response, truth).max() < 5e-3
        assert found.response.condition == "solved"


def test_errors_whitened_with_the_covariance_have_variance_one(fresh_rng, random_model):
    """Two levels and two realisations together, transients and all."""
    model = random_model(fresh_rng, (2, 2), friction=True)
    bench = Bench.make(fresh_rng, model, realisations=2, levels=(1.0, 0.5))
    quiet = bench.record()
    truth = joint_response(quiet).response
    powers, inside = [], []
    for _ in range(16):
        found = joint_response(with_noise(quiet, fresh_rng)).response
        there = np.isin(np.round(truth.frequencies, 6), np.round(found.frequencies, 6))
        assert there.sum() >= 0.9 * there.size
        error = (found.response - truth.response[there]).reshape(-1, 4)
        whiten = np.linalg.inv(np.linalg.cholesky(found.covariance))
        powers.append(np.mean(np.abs(np.einsum("fab,fb->fa", whiten, error)) ** 2))
        share = (found.response - truth.response[there]) / found.std
        inside.append(np.mean(np.abs(np.concatenate([share.real, share.imag])) < 1.96))
    assert 0.9 < np.mean(powers) < 1.12
    assert 0.93 < np.mean(inside) < 0.97


def test_more_experiments_than_axes_in_one_set(fresh_rng, random_model):
    model = random_model(fresh_rng, (1, 2))
    bench = Bench.make(fresh_rng, model, realisations=2)
    bench.references.pop()
    quiet = bench.record()
    truth = joint_response(quiet).response
    powers = []
    for _ in range(10):
        found = joint_response(with_noise(quiet, fresh_rng)).response
        error = (found.response - truth.response).reshape(-1, 4)
        whiten = np.linalg.inv(np.linalg.cholesky(found.covariance))
        powers.append(np.mean(np.abs(np.einsum("fab,fb->fa", whiten, error)) ** 2))
    assert 0.85 < np.mean(powers) < 1.2


def test_lines_that_the_reference_does_not_excite_are_masked(fresh_rng, random_model):
    model = random_model(fresh_rng, (2, 2))
    bench = Bench.make(fresh_rng, model, settle=4.0)
    recording = bench.record()
    # A coherent disturbance (same in every period) at an odd and an even line nobody asked for.
    time = np.arange(recording.experiments[0].samples) * STEP
    extra = 2.0 * np.cos(2 * np.pi * np.outer(time, [52, 55]) / PERIOD).sum(axis=1)
    for number, one in enumerate(recording.experiments):
        recording = changed(recording, number, torque=one.torque + extra[:, None])
    found = joint_response(recording)
    assert set(np.round(found.response.frequencies * PERIOD)) == set(bench.lines)


def test_rounding_of_the_reference_excites_nothing(fresh_rng, random_model):
    bench = Bench.make(fresh_rng, random_model(fresh_rng, (2, 2)))
    counts = 2 * np.pi / 2**18
    bench.references = [np.round(one / counts) * counts for one in bench.references]
    recording = with_noise(bench.record(), fresh_rng)
    lines = np.round(joint_response(recording).response.frequencies * PERIOD)
    assert set(lines) <= set(bench.lines)
    assert lines.size > 0.8 * bench.lines.size


def test_constant_velocity_does_not_leak(fresh_rng, random_model):
    bench = Bench.make(fresh_rng, random_model(fresh_rng, (2, 2)))
    plain = joint_response(bench.record()).response.response
    time = np.arange(len(bench.references[0]))[:, None] * STEP / FINE
    bench.references = [one + time * np.array([0.3, -0.2]) for one in bench.references]
    moving = joint_response(bench.record()).response.response
    assert relative(moving, plain).max() < 1e-4


# --- what the sampled torque holds besides --------------------------------------------------------


def test_folded_images_of_linear_targets_are_taken_off(fresh_rng, random_model):
    """A drive that goes straight from target to target: simulated at the bus's own step."""
    model = random_model(fresh_rng, (2, 2))
    bench = Bench.make(fresh_rng, model, lines=np.arange(1, 24, 2))
    bench.references = [one[::FINE] for one in bench.references]
    names = model.names
    experiments = []
    for number, reference in enumerate(bench.references):
        position, torque = bench.closed.simulate(reference, STEP)
        again = reference[-round(PERIOD / STEP)]  # what follows the last row
        late = np.vstack([reference[1:], again[None]])  # sent one SYNC before it is reached
        experiments.append(
            Experiment(
                f"m{number}", "multisine", names, (), PERIOD, np.arange(len(late)) * STEP,
                position, torque, position_reference=late,
            )
        )  # fmt: skip
    axes = tuple(
        AxisInfo(name, "rotary", controller=Controller(loop.position_p, loop.velocity_p,
                                                       loop.velocity_i, 1e3))
        for name, loop in zip(names, bench.closed.loops, strict=True)
    )  # fmt: skip
    errors = []
    for source in ({}, {LINEAR_TARGETS: f"{names[0]}=0.0 {names[1]}=0.0"}):
        found = joint_response(Recording(STEP, axes, tuple(experiments), source=source)).response
        truth = machine_response(model, 2 * np.pi * found.frequencies)
        errors.append(np.sqrt(np.mean(relative(found.response, truth) ** 2)))
    assert errors[1] < 0.2 * errors[0]


def test_folded_phasors_need_lag_and_controller():
    bare = Recording(STEP, (AxisInfo("a", "rotary"),), source={LINEAR_TARGETS: "a=0.0001"})
    assert np.all(folded_phasors(bare, np.array([5.0]), np.ones((1, 1), complex)) == 0)


@pytest.mark.parametrize("share", [0.0, 0.25, 0.75])
def test_held_offset_gives_the_component_of_the_staircase(fresh_rng, share):
    """A staircase made of many small steps has the component that the formula says."""
    N, fine = 40, 400
    rows = 2
    period = 0.004
    wave = fresh_rng.normal() + 1j * fresh_rng.normal()
    sent = np.real(wave * np.exp(2j * np.pi * 3 * np.arange(N) / N))
    stairs = np.repeat(np.roll(sent, rows), fine)  # value k - rows from instant k on
    sampled_at = np.arange(N) * fine + int(share * fine)
    turn = np.exp(-2j * np.pi * 3 * (np.arange(N * fine) + 0.5) / (N * fine))
    # Phases are counted from the first sample of the torque.
    from_sample = np.exp(2j * np.pi * 3 * share / N)
    component = 2 * np.mean(stairs * turn) * from_sample
    phasor = 2 * np.mean(stairs[sampled_at] * np.exp(-2j * np.pi * 3 * np.arange(N) / N))
    frequency = np.array([3 / (N * period)])
    added = held_offset(frequency, np.array([[wave]]), period, share * period, rows)[0, 0]
    assert phasor + added == pytest.approx(component, rel=1e-4)


def test_torque_offsets_are_corrected_in_the_matrix(fresh_rng, random_model):
    model = random_model(fresh_rng, (1, 1), friction=True)
    bench = Bench.make(fresh_rng, model, lines=np.arange(1, 100, 2))
    sent = [one[::FINE] * 3e4 * np.array([1.0, -1.0]) for one in bench.references]
    names = model.names
    experiments = []
    for number, values in enumerate(sent):
        still = np.zeros((len(values) * FINE, 2))
        position, torque = bench.closed.simulate(
            still, STEP / FINE, torque_offset=np.repeat(values, FINE, axis=0)
        )
        experiments.append(
            Experiment(
                f"m{number}", "multisine", names, (), PERIOD, np.arange(len(values)) * STEP,
                position[::FINE], torque[::FINE], position_reference=still[::FINE],
                extra={f"{name}.torque_offset": values[:, k] for k, name in enumerate(names)},
            )
        )  # fmt: skip
    axes = tuple(AxisInfo(name, "rotary") for name in names)
    recording = Recording(STEP, axes, tuple(experiments))
    found = joint_response(recording, offset_sampled=0.0, offset_rows=0).response
    truth = machine_response(model, 2 * np.pi * found.frequencies)
    assert np.sqrt(np.mean(relative(found.response, truth) ** 2)) < 0.03
    uncorrected = [replace(one, torque_reference=np.column_stack(list(one.extra.values())), extra={})
                   for one in experiments]  # fmt: skip
    raw = joint_response(Recording(STEP, axes, tuple(uncorrected))).response
    assert np.sqrt(np.mean(relative(raw.response, truth) ** 2)) > 0.1


# --- distortion ---------------------------------------------------------------------------------


def disturbed(bench, shape):
    """Recording with a torque that the drives do not report: a function of the axes' velocity."""
    recording = bench.record()
    for number, (one, reference) in enumerate(
        zip(recording.experiments, bench.references, strict=True)
    ):
        clean, _ = bench.closed.simulate(reference, STEP / FINE)
        torque = shape(np.gradient(clean, STEP / FINE, axis=0))
        position, total = bench.closed.simulate(reference, STEP / FINE, torque_offset=torque)
        recording = changed(
            recording, number, position=position[::FINE], torque=(total - torque)[::FINE],
            position_reference=one.position_reference,
        )  # fmt: skip
    return recording


def test_friction_shows_as_odd_distortion_that_falls_with_amplitude(fresh_rng, random_model):
    model = random_model(fresh_rng, (2, 2), friction=True)
    bench = Bench.make(fresh_rng, model, levels=(1.0, 0.4), settle=3.0)
    friction = np.array([0.1, 0.0])
    recording = disturbed(bench, lambda velocity: -friction * np.tanh(velocity / 1e-3))
    found = joint_response(with_noise(recording, fresh_rng))
    ours = [one for one in found.distortion if one.axis == model.names[0]]
    assert [round(one.level, 1) for one in ours] == [1.0, 0.4]
    assert ours[0].odd_share > 2 * ours[0].even_share
    assert ours[1].trend == "falls with amplitude"
    assert any(model.names[0] in note and "friction-like" in note for note in found.notes)
    assert any(
        "changes by" in note and "Hz when the amplitude falls to 0.4" in note
        for note in found.notes
    )
    assert any("standard errors were raised" in note for note in found.notes)


def test_straight_machine_shows_no_distortion(fresh_rng, random_model):
    bench = Bench.make(fresh_rng, random_model(fresh_rng, (2, 2)), levels=(1.0, 0.4))
    found = joint_response(with_noise(bench.record(), fresh_rng))
    assert all(max(one.odd_share, one.even_share) < 0.01 for one in found.distortion)
    assert not any("distortion" in note or "changes" in note for note in found.notes)
    assert not any("raised" in note for note in found.notes)


def test_strong_distortion_is_refused(fresh_rng, random_model):
    model = random_model(fresh_rng, (2, 2), friction=True)
    bench = Bench.make(fresh_rng, model, settle=3.0)
    recording = disturbed(bench, lambda velocity: -np.array([3.0, 0.0]) * np.tanh(velocity / 1e-3))
    with pytest.raises(
        NotEnoughDataError, match=r"axis axis[12] is strongly non-linear: odd .* dB"
    ):
        joint_response(recording)


# --- bad data -----------------------------------------------------------------------------------


@pytest.fixture
def good(fresh_rng, random_model):
    bench = Bench.make(fresh_rng, random_model(fresh_rng, (2, 2)))
    return with_noise(bench.record(), fresh_rng)


def refused(recording, pattern):
    with pytest.raises(NotEnoughDataError, match=pattern):
        joint_response(recording)


def cut(one, rows):
    """Keep the leading rows of an experiment."""
    return {
        "time": one.time[:rows],
        "position": one.position[:rows],
        "torque": one.torque[:rows],
        "position_reference": one.position_reference[:rows],
    }


def test_too_short_a_record(good):
    short = changed(good, 0, **cut(good.experiments[0], 1500))
    refused(short, r"m1: .* 1.50 periods of 2 s, at least 2 .* measure longer")


def test_missing_period_is_found(good):
    unknown = changed(changed(good, 0, period=None), 1, period=None)
    expected = joint_response(good).response.response
    assert np.array_equal(joint_response(unknown).response.response, expected)
    bare = replace(good.experiments[0], period=None, position_reference=None)
    assert find_period(bare, STEP) == pytest.approx(PERIOD)


def test_no_period_at_all(good, fresh_rng):
    one = good.experiments[0]
    wild = changed(good, 0, period=None, position_reference=fresh_rng.normal(size=one.torque.shape))
    refused(wild, "m1 has no period given, and its references repeat at no shift")
    noise = fresh_rng.normal(size=one.torque.shape)
    refused(
        changed(good, 0, period=None, position_reference=None, torque=noise),
        "m1 has no period given, and its torques repeat at no shift",
    )


def test_saturated_torque(good):
    one = good.experiments[1]
    limit = np.quantile(np.abs(one.torque[:, 0]), 0.95)
    torque = one.torque.copy()
    torque[:, 0] = np.clip(torque[:, 0], -limit, limit)
    refused(changed(good, 1, torque=torque), r"m2: the torque of axis1 is saturated, .* N m .* %")


def test_smooth_peaks_are_no_saturation(good):
    for one in good.experiments:
        for counts in (0.0, 0.001, 0.02):
            size = counts * np.ptp(one.torque[:, 0])
            torque = np.round(one.torque / size) * size if size else one.torque
            check_saturation(replace(one, torque=torque), 0, "axis1", "N m", slice(None), 2)


FLAT = ((1.0,), (1.0, -1 / 9), (1.0, -1 / 6, 1 / 50))
"""Cosines of one, three and five times a frequency: more derivatives vanish at the crest with each."""


def crests(rng):
    """Torque in N m, flat or sharp at its crests, and its number of periods."""
    shares = np.array(FLAT[rng.integers(3)])
    shares[1:] *= rng.uniform(0.95, 1.05, shares.size - 1)
    samples, periods = int(rng.integers(60, 400)), int(rng.integers(2, 5))
    angle = 2 * np.pi * (np.arange(samples * periods) / samples + rng.random())
    wave = sum(share * np.cos((2 * k + 1) * angle) for k, share in enumerate(shares))
    return rng.lognormal(0, 2) * (wave / np.ptp(wave) + rng.uniform(-1, 1)), periods


def coarse(rng, torque):
    """Round to a step of up to a thousandth of the range, or not at all."""
    step = rng.choice([0.0, rng.uniform(1e-4, 1e-3)]) * np.ptp(torque)
    return np.round(torque / step) * step if step else torque


def checked(torque, periods):
    rows, column = np.arange(torque.size) * STEP, torque[:, None]
    one = Experiment("m1", "multisine", ("axis1",), (), None, rows, 0.0 * column, column)
    check_saturation(one, 0, "axis1", "N m", slice(None), periods)


def test_a_crest_that_several_sines_make_flat_is_no_limit(fresh_rng):
    for _ in range(60):
        torque, periods = crests(fresh_rng)
        noise = fresh_rng.choice([0.0, 1e-4]) * np.ptp(torque)
        noisy = torque + noise * fresh_rng.normal(size=torque.size)
        checked(coarse(fresh_rng, noisy), periods)


@pytest.mark.parametrize("sides", [(True, True), (True, False), (False, True)])
def test_a_limit_is_found_whatever_it_cuts_off(sides, fresh_rng):
    """Under noise before the limit or behind it, and whatever the torque is rounded to.

    Of clipped multisines drawn like these one in a thousand is not seen: two of twenty are chance once
    in 5000 runs.
    """
    missed = 0
    for _ in range(20):
        torque, periods = crests(fresh_rng)
        middle, span = (torque.max() + torque.min()) / 2, np.ptp(torque)
        cut = fresh_rng.uniform(0.2, 0.35) * span
        limits = [
            middle + sign * cut if side else sign * np.inf
            for side, sign in zip(sides, (-1, 1), strict=True)
        ]
        before, behind = fresh_rng.choice([0.0, 1e-4], 2) * span
        torque = np.clip(torque + before * fresh_rng.normal(size=torque.size), *limits)
        torque = coarse(fresh_rng, torque + behind * fresh_rng.normal(size=torque.size))
        try:
            checked(torque, periods)
            missed += 1
        except NotEnoughDataError as error:
            assert re.search(r"it stays at .* N m .* %", str(error))  # noqa: PT017
    assert missed <= 1


def test_a_crest_with_ripples_is_no_limit():
    """Of a joint multisine: within 0.2 % of its range for 10 samples, and steep beside them."""
    depth = [
        79.3,
        66.0,
        55.0,
        46.2,
        39.6,
        34.9,
        31.7,
        29.7,
        28.5,
        27.7,
        26.9,
        25.9,
        24.6,
        22.7,
        20.5,
    ]
    depth += [
        17.8,
        14.8,
        11.9,
        8.97,
        6.37,
        4.17,
        2.46,
        1.24,
        0.49,
        0.11,
        0.0,
        0.03,
        0.09,
        0.12,
        0.11,
    ]
    depth += [0.12, 0.31, 0.91, 2.23, 4.62, 8.49, 14.2, 22.1, 32.5, 45.6, 61.3, 79.7, 100, 123, 147]
    half = 250 - np.array(depth)
    checked(np.tile(np.concatenate([half, -half]), 2) / 50, 2)


def test_axis_that_is_not_excited(good):
    for number in (0, 1):
        reference = good.experiments[number].position_reference.copy()
        reference[:, 1] = 0.0
        good = changed(good, number, position_reference=reference)
    refused(good, "axis2 was not excited: .* its torque only answers")


def test_axis_that_is_switched_off(good, fresh_rng):
    for number in (0, 1):
        reference = good.experiments[number].position_reference.copy()
        reference[:, 1] = 0.0
        torque = good.experiments[number].torque.copy()
        torque[:, 1] = fresh_rng.normal(size=torque.shape[0])
        good = changed(good, number, position_reference=reference, torque=torque)
    refused(good, "axis2 was not excited: .* its torque is within the noise")


def test_fewer_experiments_than_axes(good):
    refused(
        replace(good, experiments=good.experiments[:1]),
        r"needs 2 different multisine experiments with one period, there are 1 \(m1\): measure 1 more",
    )
    refused(replace(good, experiments=()), "no complete multisine experiment")


def test_duplicate_experiments(good):
    first = good.experiments[0]
    twin = replace(first, name="twin")
    refused(
        replace(good, experiments=(first, twin)),
        r"m1, twin are no 2 different ones: the condition number .* m1 and twin are alike",
    )


def test_all_lines_in_noise(good, fresh_rng):
    drowned = with_noise(good, fresh_rng, (1e-3, 1e-3, 1e4, 1e4))
    refused(drowned, "at none of .* excited lines do 2 of them stand out")


def test_fading_rows_are_left_out(good):
    one = good.experiments[0]
    reference = one.position_reference.copy()
    reference[:100] *= np.linspace(0, 1, 100)[:, None]
    rows, periods = whole_periods(replace(one, position_reference=reference), 1000)
    assert (rows.start, rows.stop, periods) == (one.samples - 2000, one.samples, 2)
    with pytest.raises(NotEnoughDataError, match="do not repeat after 1250 samples"):
        whole_periods(replace(one, position_reference=reference), 1250)
