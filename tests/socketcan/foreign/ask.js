// A CANopen master of other hands (npm: canopen, socketcan): asks a drive who it is, maps a PDO,
// enables it, and prints what it found as JSON.
//
//   node ask.js INTERFACE NODE
const { Device, DataType } = require('canopen');
const can = require('socketcan');

const [name, text] = process.argv.slice(2);
const node = Number(text);
const channel = can.createRawChannel(name);
const device = new Device({ id: 0x7E });
device.addListener('message', (message) => channel.send(message));
channel.addListener('onMessage', (message) => device.receive(message));

const { UNSIGNED8, UNSIGNED16, UNSIGNED32, INTEGER8, INTEGER32, VISIBLE_STRING } = DataType;
const read = (index, subIndex, dataType) =>
    device.sdo.upload({ deviceId: node, index, subIndex, dataType, timeout: 2000 });
const write = (index, subIndex, dataType, data) =>
    device.sdo.download({ deviceId: node, index, subIndex, dataType, data, timeout: 2000 });
const sleep = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

async function main() {
    const found = { answers: 0, heartbeats: [], pdos: [], aborts: [] };
    device.eds.addSdoClientParameter(node, 0x600 | node, 0x580 | node);
    device.eds.addHeartbeatConsumer(node, 500);
    const status = device.eds.addEntry(0x2041, { parameterName: 'statusword', dataType: UNSIGNED16 });
    const place = device.eds.addEntry(0x2064, { parameterName: 'position', dataType: INTEGER32 });
    device.eds.addReceivePdo({ cobId: 0x180 | node, dataObjects: [status, place] });
    device.eds.setSyncCobId(0x80);
    device.eds.setSyncGenerationEnable(true);
    device.eds.setSyncCyclePeriod(20000);
    device.nmt.addListener('heartbeat', (beat) => found.heartbeats.push(beat.deviceId ?? beat));
    channel.addListener('onMessage', ({ id }) => found.answers += id === (0x180 | node));
    // told only where a value has changed
    device.pdo.on('pdo', ({ cobId, dataObjects }) =>
        found.pdos.push([cobId, ...dataObjects.map((object) => object.value)]));
    channel.start();
    device.start();

    found.deviceType = await read(0x1000, 0, UNSIGNED32);
    found.serial = await read(0x1018, 4, UNSIGNED32);
    found.name = await read(0x1008, 0, VISIBLE_STRING);
    try {
        await read(0x5FFF, 0, UNSIGNED32);
    } catch (error) {
        found.aborts.push(error.code);
    }
    await write(0x1017, 0, UNSIGNED16, 50);
    await write(0x1800, 1, UNSIGNED32, 0x80000180 + node);
    await write(0x1800, 2, UNSIGNED8, 1);
    await write(0x1A00, 0, UNSIGNED8, 0);
    await write(0x1A00, 1, UNSIGNED32, 0x60410010);
    await write(0x1A00, 2, UNSIGNED32, 0x60640020);
    await write(0x1A00, 0, UNSIGNED8, 2);
    await write(0x1800, 1, UNSIGNED32, 0x180 + node);

    await write(0x6060, 0, INTEGER8, 8);
    await write(0x607A, 0, INTEGER32, await read(0x6064, 0, INTEGER32));
    device.nmt.startNode();
    device.nmt.startNode(node);
    for (const word of [6, 7, 15])
        await write(0x6040, 0, UNSIGNED16, word);
    found.enabled = await read(0x6041, 0, UNSIGNED16);
    for (let k = 0; k < 200 && found.answers < 20; ++k)
        await sleep(50);
    await write(0x6040, 0, UNSIGNED16, 0);
    found.disabled = await read(0x6041, 0, UNSIGNED16);
    found.state = await device.nmt.getNodeState(node);
    device.stop();
    channel.stop();
    console.log(JSON.stringify(found));
    process.exit(0);
}

main().catch((error) => {
    console.error(error);
    process.exit(1);
});
