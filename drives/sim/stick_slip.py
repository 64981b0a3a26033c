"""Masses that stick and slide: exact pieces of linear motion between events.

Between two events the machine is linear: a mass with dry friction either stands (it is held, and is
no degree of freedom) or slides (friction is a constant torque against its direction)::

    stands ──▶ friction needed exceeds its limit ──▶ slides ◀──┐
       ▲                                               │       │ friction can not hold
       └── friction holds ◀── velocity passes zero ◀───┴───────┘

Each piece is an exact step of the machine with the standing masses held, as in
:mod:`drives.sim.plant`.  So a standing mass does not creep, not even by rounding, and there is no
smoothing constant.  A piece in which something happens is halved until it is one tick (1/256 of an
inner step), and the event is taken to be at its beginning (a stop) or its end (a breakaway).

Energy: in every piece that is taken each sliding mass moves on in its direction, so friction only
takes energy out.  A mass that stops loses its last velocity (that of one tick) by a push on the
standing masses alone; that is a projection in the mass matrix and can only take energy out, too.
A mass that turns without stopping feels no friction in the tick in which it does.  So an event
changes the momentum by at most twice the friction torque times one tick more or less than it should.

Which masses break away when several stand, coupled by inertia, is the contact problem of Coulomb
friction with given limits: a strictly convex quadratic programme with one answer.

Valid for: friction torques that depend on the direction alone.  A sliding mass that turns back and
forth again within one piece, its displacement still forward, is taken to slide on.

Matrices belong to a set of standing masses.  They are made when that set first occurs, and are all
made anew when they would need more than 64 MB.
"""

from collections.abc import Sequence

import numpy as np

from drives.sim.effects import FloatArray
from drives.sim.plant import Plant
from drives.sim.servo_kernel import LEVELS, TICKS, BoolArray, Holding, Progress

_LARGEST_TABLES = 64_000_000
"""Bytes."""
_RELEASED = 1e-12
"""Friction of an open brake, of its torque when closed: a mass without any could not stand or slide."""


class StickSlip:
    """Dry friction of one plant in steps of one length.

    Parameters
    ----------
    plant
        With friction (``plant.breakaway``) or brakes on some masses, or none.
    step
        Inner step, s.
    forced
        Numbers of further masses on which forces act that are held over the inner step.
    """

    def __init__(self, plant: Plant, step: float, forced: Sequence[int] = ()) -> None:
        self._plant, self._step = plant, step
        limits = plant.breakaway.copy()
        limits[plant.motors] = np.maximum(limits[plant.motors], _RELEASED * plant.brakes)
        self._masses = np.flatnonzero(limits > 0.0)
        count = self._masses.size
        self._pushed = np.concatenate(
            [plant.motors, self._masses, np.asarray(forced, dtype=np.intp)]
        )
        """Number of the mass that each torque acts on."""
        place = {int(mass): k for k, mass in enumerate(self._masses)}
        braked = plant.brakes > 0.0
        self.brakes = np.array(
            [place[int(m)] if b else -1 for m, b in zip(plant.motors, braked, strict=True)],
            dtype=np.int64,
        )
        """Place of each axis' brake among the masses that can be held, shape (M,); -1: none."""
        self.brake_limits = np.column_stack(
            [limits[plant.motors], limits[plant.motors] + plant.brakes]
        )
        """Friction of each motor with its brake open, and closed, N m, shape (M, 2)."""
        rates, pushes = plant.first_order()
        rows = plant.size + self._masses
        columns = 2 * plant.size + self._pushed.size
        order = 2 * plant.size
        largest = 8 * LEVELS * columns * order
        self._most_sets = max(2, _LARGEST_TABLES // largest)
        self.tables = Holding(
            masses=self._masses.astype(np.int64),
            limits=limits[self._masses],
            accelerations=np.hstack([rates[rows], pushes[np.ix_(rows, self._pushed)]]),
            mobility=pushes[np.ix_(rows, self._masses)],
            directions=np.zeros(count),
            passing=np.zeros(count, dtype=np.bool_),
            inputs=np.zeros(columns),
            progress=np.zeros(Progress.COLUMNS, dtype=np.int64),
            standing=np.zeros((0, count), dtype=np.bool_),
            increments=np.zeros((0, LEVELS, columns, order)),
            reactions=np.zeros((0, count, columns)),
            carried=np.zeros((0, count, plant.size)),
        )
        """What the compiled loop takes."""

    def set_state(self, state: FloatArray) -> None:
        """Begin an inner step at a state (q, q'), shape (2n,): what has velocity slides."""
        self.tables.directions[:] = np.sign(state[self._plant.size + self._masses])
        self.tables.passing[:] = False
        self.tables.progress[:] = 0

    def add_set(self) -> None:
        """Make the tables for the masses that stand now."""
        old = self.tables
        standing = old.directions == 0.0
        if len(old.standing) >= self._most_sets:
            old = old._replace(
                standing=old.standing[:0],
                increments=old.increments[:0],
                reactions=old.reactions[:0],
                carried=old.carried[:0],
            )
        self.tables = old._replace(
            standing=np.concatenate([old.standing, standing[None]]),
            increments=np.concatenate([old.increments, self._increments(standing)[None]]),
            reactions=np.concatenate([old.reactions, self._reactions(standing)[None]]),
            carried=np.concatenate([old.carried, self._carried(standing)[None]]),
        )

    def _increments(self, standing: BoolArray) -> FloatArray:
        """Transposes of [Ad - I, Bd] for pieces of h, h/2, h/4 ..., shape (LEVELS, C, 2n).

        From the shortest one by doubling: with E = Ad - I, two steps are E + E + E E.
        """
        held = self._masses[standing].tolist()
        increment, forced = self._plant.increments(self._step / TICKS, held)
        forced = forced[:, self._pushed]
        tables = [np.hstack([increment, forced]).T]
        for _ in range(LEVELS - 1):
            forced = 2.0 * forced + increment @ forced
            increment = 2.0 * increment + increment @ increment
            tables.append(np.hstack([increment, forced]).T)
        return np.array(tables[::-1])

    def _reactions(self, standing: BoolArray) -> FloatArray:
        """From the rows of M q'' + C q' + K q = f + r that stand, shape (F, C)."""
        plant, n = self._plant, self._plant.size
        rates, forced = plant.first_order(self._masses[standing].tolist())
        elastic = np.hstack([plant.stiffness_matrix, plant.damping_matrix])
        of_state = plant.mass_matrix @ rates[n:] + elastic
        of_torque = plant.mass_matrix @ forced[n:] - np.eye(n)
        rows = np.hstack([of_state, of_torque[:, self._pushed]])[self._masses]
        return np.where(standing[:, None], rows, 0.0)

    def _carried(self, standing: BoolArray) -> FloatArray:
        """From M_FF dv_F + M_FS dv_S = 0 with dv_S = -v_S, shape (F, n)."""
        mass, held = self._plant.mass_matrix, self._masses[standing]
        free = np.setdiff1d(np.arange(self._plant.size), held)
        carried = np.zeros((self._masses.size, self._plant.size))
        shares = np.linalg.solve(mass[np.ix_(free, free)], mass[np.ix_(free, held)])
        carried[np.ix_(np.flatnonzero(standing), free)] = shares.T
        return carried
