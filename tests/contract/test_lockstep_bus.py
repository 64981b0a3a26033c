"""The lock-step bus as python-can's tools, a foreign CANopen client and a host see it."""

import queue
import struct
import threading
import time

import can
import canopen
import pytest

from drives.sim import faults
from drives.sim.eds import packaged_eds
from drives.sim.lockstep_bus import NOT_IMITATED, LockstepBus, register, unregister
from drives.sim.machine import SimulatedDrive, SimulatedMachine
from drives.sim.plant import ChainParameters
from drives.sim.running import RunningMachine
from drives.sim.serve import Served, serve

GAINS = {"position_p": 30.0, "velocity_p": 2.0, "velocity_i": 40.0}


def machine(axes=2, **changes):
    chain = ChainParameters((0.01,), (), (), viscous_friction=0.01)
    return SimulatedMachine(
        tuple(
            SimulatedDrive(f"axis{k}", k, chain, 10.0, 20.0, gains=GAINS, **changes)
            for k in range(1, axes + 1)
        )
    )


def frame(cob_id, data=b"", **rest):
    return can.Message(arbitration_id=cob_id, is_extended_id=False, data=data, **rest)


UPLOAD_DEVICE_TYPE = bytes((0x40, 0x00, 0x10, 0, 0, 0, 0, 0))
SYNC = frame(0x80)


@pytest.fixture
def bus():
    with LockstepBus(machine=machine()) as opened:
        yield opened


def drain(bus):
    taken = []
    while (message := bus.recv(0)) is not None:
        taken.append(message)
    return taken


class TestOpening:
    def test_by_entry_point_and_profile(self):
        with can.Bus(interface="fieldsim", channel="paper-3x3", bitrate=500_000) as opened:
            opened.send(frame(0x603, UPLOAD_DEVICE_TYPE))
            assert opened.recv(0).arbitration_id == 0x583

    def test_by_registered_name(self):
        running = register("test-bench", machine())
        try:
            with can.Bus(interface="fieldsim", channel="test-bench") as opened:
                assert opened.machine is running
                opened.clock.wait_until(1.0)
            with can.Bus(interface="fieldsim", channel="test-bench") as opened:
                assert opened.clock.now() == 1.0, "a registered machine runs on"
            with pytest.raises(ValueError, match="registered already"):
                register("test-bench", machine())
        finally:
            unregister("test-bench")

    def test_profile_machine_starts_anew_when_all_are_closed(self):
        with LockstepBus("paper-3x3") as first:
            first.clock.wait_until(1.0)
            with LockstepBus("paper-3x3") as second:
                assert second.machine is first.machine
        with LockstepBus("paper-3x3") as third:
            assert third.clock.now() == 0.0

    def test_unknown_options_are_refused(self):
        with pytest.raises(TypeError, match="bitrat"):
            LockstepBus(machine=machine(), bitrat=1)
        with pytest.raises(TypeError, match="recieve_own_messages"):
            can.Bus(interface="fieldsim", channel="paper-3x3", recieve_own_messages=True)

    @pytest.mark.parametrize("channel", [None, "", "no-such-machine"])
    def test_unknown_machines_are_refused(self, channel):
        with pytest.raises(can.CanInitializationError):
            LockstepBus(channel)

    def test_wrong_bit_rate(self):
        with pytest.raises(can.CanInitializationError, match="bit rate"):
            LockstepBus(machine=machine(), bitrate=5)

    def test_packaged_machines_are_found(self):
        found = can.detect_available_configs(interfaces=["fieldsim"])
        assert {"interface": "fieldsim", "channel": "paper-3x3"} in found

    def test_what_is_not_imitated_is_said(self):
        text = " ".join(NOT_IMITATED)
        assert all(word in text for word in ("arbitration", "bit errors", "bus load", "jitter"))
        assert "arbitration" in LockstepBus.__doc__

    def test_closed_bus(self):
        opened = LockstepBus(machine=machine())
        opened.shutdown()
        opened.shutdown()
        with pytest.raises(can.CanOperationError, match="shut down"):
            opened.send(SYNC)
        with pytest.raises(can.CanOperationError, match="shut down"):
            opened.recv(0)


class TestVirtualTime:
    def test_answers_come_at_once(self, bus):
        bus.send(frame(0x601, UPLOAD_DEVICE_TYPE))
        answer = bus.recv(0)
        assert answer.data[4:] == struct.pack("<I", 0x00020192)
        assert answer.timestamp == 0.0
        assert not answer.is_extended_id
        assert answer.is_rx

    def test_each_sync_is_one_cycle(self, bus):
        for k in range(1, 6):
            bus.send(SYNC)
            assert bus.clock.now() == k * 0.001

    def test_other_frames_take_no_time(self, bus):
        bus.send(frame(0, b"\x01\x00"))
        assert bus.clock.now() == 0.0

    def test_waiting_lets_time_pass(self, bus):
        assert bus.recv(0.25) is None
        assert bus.clock.now() == 0.25

    def test_polling_does_not(self, bus):
        assert bus.recv(0) is None
        assert bus.clock.now() == 0.0

    def test_waiting_ends_with_the_frame(self, bus):
        bus.send(frame(0x601, struct.pack("<BHBI", 0x2B, 0x1017, 0, 40)))
        drain(bus)
        beat = bus.recv(1.0)
        assert (beat.arbitration_id, beat.timestamp) == (0x701, 0.04)
        assert bus.clock.now() == pytest.approx(0.04)

    def test_endless_waiting_ends(self, bus):
        with pytest.raises(can.CanTimeoutError, match="60 s"):
            bus.recv()

    def test_no_wall_time_is_needed(self, bus):
        began = time.perf_counter()
        bus.clock.wait_until(5.0)
        assert bus.clock.now() == 5.0
        assert time.perf_counter() - began < 4.0

    def test_frames_within_a_cycle_have_their_own_times(self, bus):
        bus.send(frame(0x601, struct.pack("<BHBI", 0x23, 0x1006, 0, 100_000)))
        bus.send(frame(0x602, struct.pack("<BHBI", 0x23, 0x1006, 0, 100_000)))
        bus.send(frame(0x601, struct.pack("<BHBI", 0x2B, 0x1017, 0, 30)))
        bus.machine.inject(faults.EmergencyOnly(2), at_time=0.0455)
        drain(bus)
        bus.send(SYNC)
        stamps = [(m.timestamp, m.arbitration_id) for m in drain(bus)]
        assert stamps == [(0.03, 0x701), (0.0455, 0x82), (0.06, 0x701), (0.09, 0x701)]

    def test_nodes_that_disagree_on_the_cycle(self, bus):
        bus.send(frame(0x601, struct.pack("<BHBI", 0x2F, 0x60C2, 1, 4)))
        with pytest.raises(can.CanOperationError, match="different communication cycles"):
            bus.send(SYNC)

    def test_clock_does_not_go_back(self, bus):
        bus.clock.wait_until(0.5)
        bus.clock.wait_until(0.1)
        assert bus.clock.now() == 0.5


class TestPythonCan:
    def test_filters(self, bus):
        bus.set_filters([{"can_id": 0x582, "can_mask": 0x7FF, "extended": False}])
        bus.send(frame(0x601, UPLOAD_DEVICE_TYPE))
        bus.send(frame(0x602, UPLOAD_DEVICE_TYPE))
        assert [m.arbitration_id for m in drain(bus)] == [0x582]

    def test_own_messages(self):
        with LockstepBus(machine=machine(), receive_own_messages=True) as own:
            own.send(frame(0x601, UPLOAD_DEVICE_TYPE))
            assert [(m.arbitration_id, m.is_rx) for m in drain(own)] == [
                (0x601, False),
                (0x581, True),
            ]

    def test_second_bus_sees_everything(self, bus):
        with LockstepBus(machine=bus.machine) as logger:
            bus.send(frame(0x601, UPLOAD_DEVICE_TYPE))
            assert [m.arbitration_id for m in drain(logger)] == [0x601, 0x581]
            assert [m.arbitration_id for m in drain(bus)] == [0x581]

    def test_frames_of_other_kinds_are_not_for_nodes(self, bus):
        bus.send(can.Message(arbitration_id=0x601, data=UPLOAD_DEVICE_TYPE, is_extended_id=True))
        bus.send(frame(0x601, is_remote_frame=True, dlc=8))
        assert drain(bus) == []
        with pytest.raises(can.CanOperationError, match="FD"):
            bus.send(can.Message(arbitration_id=1, is_fd=True))

    def test_periodic_messages_go_out_in_virtual_time(self, bus):
        with LockstepBus(machine=bus.machine) as logger:
            task = bus.send_periodic(frame(0x764, b"\x05"), 0.02)
            bus.clock.wait_until(0.1)
            stamps = [m.timestamp for m in drain(logger)]
            assert stamps == pytest.approx([0.0, 0.02, 0.04, 0.06, 0.08, 0.1])
            task.modify_data(frame(0x764, b"\x7f"))
            bus.clock.wait_until(0.12)
            assert drain(logger)[-1].data == b"\x7f"
            task.stop()
            bus.clock.wait_until(1.0)
            assert drain(logger) == []

    def test_periodic_messages_of_limited_duration(self, bus):
        with LockstepBus(machine=bus.machine) as logger:
            bus.send_periodic(frame(0x764, b"\x05"), 0.02, duration=0.05)
            bus.clock.wait_until(1.0)
            assert len(drain(logger)) == 3

    def test_periodic_sync_keeps_its_own_time(self, bus):
        bus.send_periodic(SYNC, 0.01)
        bus.clock.wait_until(0.1)
        assert bus.clock.now() == 0.1
        assert bus.machine.sync_count == 11

    def test_notifier_waits_in_wall_time(self, bus):
        reader = can.BufferedReader()
        notifier = can.Notifier(bus, [reader], timeout=0.05)
        try:
            time.sleep(0.12)
            assert bus.clock.now() == 0.0
            bus.send(frame(0x601, UPLOAD_DEVICE_TYPE))
            assert reader.get_message(timeout=2.0).arbitration_id == 0x581
        finally:
            notifier.stop()

    def test_shutdown_wakes_who_waits(self):
        opened = LockstepBus(machine=machine())
        got = []
        waiting = threading.Thread(target=lambda: got.append(opened.recv(30.0)))
        waiting.start()
        while not opened._waiting:
            time.sleep(0.001)
        opened.shutdown()
        waiting.join(5.0)
        assert got == [None]


@pytest.fixture
def network():
    """python canopen on the lock-step bus: a client from other hands than the node."""
    with LockstepBus(machine=machine()) as opened:
        net = canopen.Network(opened)
        net.NOTIFIER_CYCLE = 0.05
        net.connect()
        yield net
        net.disconnect()


@pytest.fixture
def remote(network, tmp_path):
    eds = tmp_path / "reference.eds"
    eds.write_bytes(packaged_eds())
    return network.add_node(1, str(eds))


class TestForeignClient:
    def test_expedited_and_segmented(self, remote):
        assert remote.sdo["Device type"].raw == 0x00020192
        assert remote.sdo[0x100A].raw == "1.0.0, 8 kHz cascade with two torque filters"
        remote.sdo[0x2020][3].raw = 0.25
        assert remote.sdo[0x2020][3].raw == 0.25

    def test_block_upload_of_the_eds(self, remote):
        with remote.sdo.open(0x1021, 0, "rb", block_transfer=True) as stream:
            assert stream.read() == packaged_eds()

    @pytest.mark.parametrize("size", [1, 6, 7, 8, 13, 14, 889, 890, 1_778, 5_000])
    def test_block_upload_of_any_length(self, network, remote, size):
        data = bytes(k % 251 for k in range(size))
        node = network.bus.machine.node(1)
        node.dictionary.set_read_callback(0x1021, 0, lambda: data)
        with remote.sdo.open(0x1021, 0, "rb", block_transfer=True) as stream:
            assert stream.read() == data

    def test_block_download(self, remote):
        with remote.sdo.open(0x2010, 1, "wb", size=4, block_transfer=True) as stream:
            stream.write(struct.pack("<I", 4_321))
        assert remote.sdo[0x2010][1].raw == 4_321

    def test_aborts(self, remote):
        with pytest.raises(canopen.SdoAbortedError) as refused:
            remote.sdo.download(0x6060, 0, b"\x06")
        assert refused.value.code == 0x06090030

    def test_pdos_are_mapped_and_exchanged(self, network, remote):
        for pdo, names in (
            (remote.tpdo[1], ("Statusword", "Position actual value", "Torque actual value")),
            (remote.rpdo[1], ("Controlword", "Target position", "Target torque")),
        ):
            pdo.read()
            pdo.clear()
            for name in names:
                pdo.add_variable(name)
            pdo.trans_type = 1
            pdo.enabled = True
            pdo.save()
        remote.nmt.state = "OPERATIONAL"
        came = threading.Event()
        remote.tpdo[1].add_callback(lambda _: came.set())
        remote.rpdo[1]["Controlword"].raw = 0x06
        remote.rpdo[1].transmit()
        for _ in range(2):
            came.clear()
            network.sync.transmit()
            assert came.wait(2.0)
        assert remote.tpdo[1]["Statusword"].raw == 0x0231

    def test_emergencies_arrive(self, network, remote):
        network.bus.machine.inject(faults.DriveFault(1, 0x4310, 0x08))
        assert remote.emcy.wait(timeout=2.0).code == 0x4310

    def test_heartbeat(self, network, remote):
        beats = queue.Queue()
        network.subscribe(0x701, lambda _cob, data, stamp: beats.put((bytes(data), stamp)))
        remote.nmt.state = "OPERATIONAL"
        remote.sdo[0x1017].raw = 10
        network.bus.clock.wait_until(0.025)
        assert [beats.get(timeout=2.0) for _ in range(3)] == [
            (b"\x05", 0.0),
            (b"\x05", 0.01),
            (b"\x05", 0.02),
        ]

    def test_identity_scan(self, network):
        network.scanner.search(limit=5)
        time.sleep(0.2)
        assert sorted(network.scanner.nodes) == [1, 2]


class TestServing:
    """The same nodes in real time on another bus (python-can's virtual one)."""

    def test_nodes_answer_and_time_passes(self):
        running = RunningMachine(machine())
        with (
            can.Bus(interface="virtual", channel="serve") as far,
            can.Bus(interface="virtual", channel="serve") as near,
        ):
            ended = threading.Event()
            reports: list[Served] = []
            ready = threading.Event()
            thread = threading.Thread(
                target=lambda: reports.append(serve(running, far, ended.is_set, begun=ready.set))
            )
            thread.start()
            try:
                assert ready.wait(60.0)
                boots = [near.recv(5.0) for _ in range(2)]
                assert [(m.arbitration_id, bytes(m.data)) for m in boots] == [
                    (0x701, b"\0"),
                    (0x702, b"\0"),
                ]
                near.send(frame(0x601, UPLOAD_DEVICE_TYPE))
                assert near.recv(5.0).arbitration_id == 0x581
                near.send(frame(0x601, struct.pack("<BHBI", 0x2B, 0x1017, 0, 20)))
                stamps = [near.recv(5.0).arbitration_id for _ in range(4)]
                assert sorted(set(stamps)) == [0x581, 0x701]
                near.send(SYNC)
            finally:
                ended.set()
                thread.join(10.0)
        assert running.sync_count == 1
        assert running.now > 0.03
        (report,) = reports
        assert report.frames == 3
        assert report.bus_away == 0
        assert "Served 3 frames" in report.sentence

    def test_a_slow_computer_leaves_time_out_instead_of_racing(self):
        running = RunningMachine(machine())
        ticks = iter((0.0, 10.0, 10.0))
        stops = iter((False, True))
        with can.Bus(interface="virtual", channel="slow") as far:
            report = serve(running, far, lambda: next(stops), clock=lambda: next(ticks))
        assert running.now == pytest.approx(0.05)
        assert report.left_out == pytest.approx(9.95)
        assert report.worst == pytest.approx(10.0, abs=0.01)

    @pytest.mark.parametrize(("ago", "now"), [(0.03, 0.01), (1e6, 0.04), (-5.0, 0.04)])
    def test_a_frame_acts_at_the_moment_at_which_it_came(self, ago, now):
        """A drive handles it at once; a stamp of another clock tells nothing."""

        class Kept(type(can.Bus(interface="virtual", channel="kept"))):
            def recv(self, timeout=None):
                message = super().recv(timeout)
                if message is not None:
                    message.timestamp = time.time() - ago
                return message

        running = RunningMachine(machine())
        ticks = iter((0.0, 0.04))
        stops = iter((False, True))
        with Kept(channel="kept") as far, can.Bus(interface="virtual", channel="kept") as near:
            near.send(SYNC)
            serve(running, far, lambda: next(stops), clock=lambda: next(ticks))
        assert running.sync_count == 1
        assert now - 0.009 < running.now <= now + 1e-6

    def test_a_bus_that_goes_away_does_not_stop_the_drives(self):
        """Time passes for the nodes, and they are there again when the bus is."""
        running = RunningMachine(machine())
        gone = [True]

        class Cut(type(can.Bus(interface="virtual", channel="cut"))):
            def recv(self, timeout=None):
                if gone[0]:
                    raise can.CanOperationError("Network is down")
                return super().recv(timeout)

            def send(self, msg, timeout=None):
                if gone[0]:
                    raise can.CanOperationError("Network is down")
                super().send(msg, timeout)

        with Cut(channel="cut") as far, can.Bus(interface="virtual", channel="cut") as near:
            ended, ready, reports = threading.Event(), threading.Event(), []
            thread = threading.Thread(
                target=lambda: reports.append(serve(running, far, ended.is_set, begun=ready.set))
            )
            thread.start()
            try:
                assert ready.wait(60.0)
                time.sleep(0.2)
                gone[0] = False
                near.send(frame(0x601, UPLOAD_DEVICE_TYPE))
                assert near.recv(5.0).arbitration_id == 0x581
            finally:
                ended.set()
                thread.join(30.0)
        assert reports[0].bus_away > 0.01
        assert running.now > 0.1
