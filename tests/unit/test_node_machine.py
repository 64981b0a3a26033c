"""Descriptions of simulated machines, their virtual time, and several of them in one process."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drives.errors import ProfileError
from drives.profile import load_machine
from drives.sim.machine import SimulatedDrive, SimulatedMachine, simulated_machine
from drives.sim.plant import ChainParameters
from drives.sim.running import CycleTimeError, RunningMachine
from drives.sim.scheduler import VirtualScheduler

CHAIN = ChainParameters((1.0,), (), ())


class TestScheduler:
    @given(st.lists(st.integers(0, 1_000), max_size=40))
    def test_calls_come_in_order_of_time_then_of_making(self, times):
        scheduler, called = VirtualScheduler(), []
        for number, time in enumerate(times):
            scheduler.add_at(time, lambda time=time, number=number: called.append((time, number)))
        scheduler.run_due(2_000)
        assert called == sorted(called)
        assert len(called) == len(times)

    def test_periodic_calls_keep_time(self):
        scheduler, called = VirtualScheduler(), []

        def beat():
            called.append(scheduler.now)
            scheduler.add(0.01, beat)

        scheduler.add(0.01, beat)
        scheduler.run_due(100_000_000)
        assert called == [10_000_000 * k for k in range(1, 11)]

    def test_cancelled_calls_do_not_come(self):
        scheduler, called = VirtualScheduler(), []
        keep, drop = (scheduler.add(0.1, called.append, (k,)) for k in (1, 2))
        scheduler.cancel(drop)
        scheduler.cancel(drop)
        assert scheduler.next_due == keep.due
        scheduler.run_due(1_000_000_000)
        assert called == [1]
        assert scheduler.next_due is None

    def test_time_does_not_go_back(self):
        scheduler = VirtualScheduler()
        scheduler.run_due(10)
        with pytest.raises(ValueError, match="can not go back"):
            scheduler.run_due(9)
        with pytest.raises(ValueError, match="negative"):
            scheduler.add(-1.0, print)


class TestDescription:
    @pytest.mark.parametrize(
        ("changes", "message"),
        [
            ({"node_id": 0}, "node id 0"),
            ({"peak_torque": -1.0}, "peak torque"),
            ({"peak_torque": 1_000.0}, "can not show it"),
            ({"kind": "linear"}, "counts_per_metre"),
            ({"counts_per_metre": 5.0}, "counts_per_metre"),
            ({"gains": {"positon_p": 1.0}}, "no gain 'positon_p'"),
            ({"gains": {"position_p": 1e9}}, "out of the simulated drive's range"),
            ({"rated_torque": -1.0, "peak_torque": 1.0}, "rated"),
            ({"store_time": -1.0}, "store time"),
        ],
    )
    def test_nonsense_is_refused(self, changes, message):
        settings = {"node_id": 1, "rated_torque": 1.0, "peak_torque": 2.0} | changes
        with pytest.raises(ValueError, match=message):
            SimulatedDrive("a", chain=CHAIN, **settings)

    def test_names_and_node_ids_differ(self):
        one = SimulatedDrive("a", 1, CHAIN, 1.0, 2.0)
        with pytest.raises(ValueError, match="node_id"):
            SimulatedMachine((one, SimulatedDrive("b", 1, CHAIN, 1.0, 2.0)))
        with pytest.raises(ValueError, match="name"):
            SimulatedMachine((one, SimulatedDrive("a", 2, CHAIN, 1.0, 2.0)))

    def test_packaged_machine(self):
        profile = load_machine("paper-3x3")
        machine = simulated_machine(profile)
        assert [d.node_id for d in machine.drives] == [axis.node_id for axis in profile.axes]
        assert machine.couplings == ((0, 1, 1.0), (0, 2, 2.0), (1, 2, 3.0))
        assert machine.drives[0].chain.masses == (0.7, 2.0, 3.0)
        assert machine.drives[0].factory_objects[0x2010, 1] == 6_000
        assert machine.drives[0].factory_objects[0x6076, 0] == 50_000

    def test_profile_without_simulation(self):
        profile = load_machine("paper-3x3").model_copy(update={"simulation": None})
        with pytest.raises(ProfileError, match="no `simulation` section"):
            simulated_machine(profile)

    def test_overridden_objects_win(self, rig_of):
        rig = rig_of(1, objects={(0x6076, 0): 0, (0x6065, 0): 77})
        assert rig.read("I", 0x6076) == 0
        assert rig.read("I", 0x6065) == 77
        with pytest.raises(KeyError, match="0x5FFF"):
            rig_of(1, objects={(0x5FFF, 0): 0})


class TestRunning:
    def test_cycle_follows_the_objects(self, rig):
        assert rig.machine.period == 1_000_000
        rig.write("B", 0x60C2, 1, 4)
        assert rig.machine.period == 4_000_000
        rig.write("I", 0x1006, 0, 2_000)
        assert rig.machine.period == 2_000_000

    def test_disagreement_is_named(self, rig_of):
        rig = rig_of(2)
        rig.write("B", 0x60C2, 1, 4, node=2)
        with pytest.raises(CycleTimeError, match="node 1: 1 ms, node 2: 4 ms"):
            _ = rig.machine.period
        rig.nmt(1, node=2)
        assert rig.machine.period == 4_000_000, "only operational nodes count"

    def test_a_cycle_that_the_loops_can_not_keep(self, rig):
        rig.write("I", 0x1006, 0, 1_100)
        with pytest.raises(CycleTimeError, match="multiple"):
            _ = rig.machine.period

    def test_firmware_and_bus_share_one_time(self, rig):
        for seconds in (0.00007, 0.00007, 0.1, 0.0333):
            rig.run(seconds)
        assert rig.machine.axes.time == pytest.approx(rig.machine.now, abs=125e-6)

    def test_machines_in_one_process_do_not_mix(self, rig_of):
        a, b = rig_of(1), rig_of(1)
        a.write("H", 0x1017, 0, 10)
        b.take()
        a.run(0.1)
        assert b.take() == []
        assert b.machine.now == 0.0
        a.write("I", 0x2010, 1, 5)
        assert b.read("I", 0x2010, 1) == 30_000

    def test_same_seed_same_noise(self):
        def torques(seed):
            drive = SimulatedDrive("a", 1, CHAIN, 1.0, 2.0, torque_noise=0.1)
            axes = RunningMachine(SimulatedMachine((drive,), seed=seed)).axes
            return [int(axes.latch()[1][0]) for _ in range(20)]

        assert torques(3) == torques(3)
        assert torques(3) != torques(4)
