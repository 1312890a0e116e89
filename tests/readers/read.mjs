// Reads logs with @mcap/core, protobufjs and fzstd, with nothing of Overfly's, and prints a line of JSON a file:
// {topic: {schema, count, first, last, newest}}, log times in ns as text, `newest` the last message as proto3 JSON.
//
//   node read.mjs [--cut] FILE...
//
// --cut: the file has no end, as after a kill; it is read up to its last whole chunk.
// Exit code 1 at the first message that does not decode as a whole, log time that goes back, CRC that is wrong, or
// difference between what the file holds and what its summary says.
import { McapIndexedReader, McapStreamReader } from "@mcap/core";
import { decompress } from "fzstd";
import { open, readFile } from "node:fs/promises";
import protobuf from "protobufjs";
import descriptor from "protobufjs/ext/descriptor.js";
import protojson from "protobufjs/ext/protojson.js";

const decompressHandlers = { zstd: (data, size) => decompress(data, new Uint8Array(Number(size))) };

// The type of a schema, from the FileDescriptorSet that the log holds.
function typeOf(schema) {
  if (schema.encoding !== "protobuf") throw new Error(`schema ${schema.name} is not protobuf`);
  return protobuf.Root.fromDescriptor(descriptor.FileDescriptorSet.decode(schema.data)).lookupType(schema.name);
}

// A message, decoded as a whole: what its type does not know is dropped, so it would be missing when encoded again.
function decode(topic, type, data) {
  const message = type.decode(data);
  if (Buffer.compare(type.encode(message).finish(), data) !== 0) {
    throw new Error(`${topic}: a message is not what its schema describes`);
  }
  return message;
}

// Counts one message in `topics`, and keeps it as the newest of its topic.
function count(topics, { topic, schema, type }, record) {
  const seen = (topics[topic] ??= { schema, count: 0, first: `${record.logTime}` });
  const newest = { type, message: decode(topic, type, record.data) };
  Object.assign(seen, { count: seen.count + 1, last: `${record.logTime}`, newest });
}

// Every message in the order of the file.
function readStream(bytes, cut) {
  const [schemas, channels, topics] = [new Map(), new Map(), {}];
  let time = 0n;
  const take = {
    Schema: (record) => schemas.set(record.id, { schema: record.name, type: typeOf(record) }),
    Channel: (record) => {
      if (record.messageEncoding !== "protobuf") throw new Error(`${record.topic} is not protobuf`);
      channels.set(record.id, { topic: record.topic, ...schemas.get(record.schemaId) });
    },
    Message: (record) => {
      const channel = channels.get(record.channelId);
      if (record.logTime < time) throw new Error(`${channel.topic}: log time ${record.logTime} comes after ${time}`);
      time = record.logTime;
      count(topics, channel, record);
    },
  };
  const reader = new McapStreamReader({ decompressHandlers, validateCrcs: true });
  reader.append(bytes);
  for (let record; (record = reader.nextRecord()) !== undefined; ) take[record.type]?.(record);
  if (!cut && !reader.done()) throw new Error("the file has no end");
  return topics;
}

// What @mcap/core wants of an open file.
const readable = (file) => ({
  size: async () => BigInt((await file.stat()).size),
  read: async (offset, length) => {
    const { buffer } = await file.read(Buffer.alloc(Number(length)), 0, Number(length), Number(offset));
    return new Uint8Array(buffer.buffer, buffer.byteOffset, buffer.byteLength);
  },
});

// {topic: messages} by the summary and the index at the end of the file; attachments and metadata are read as well.
async function readIndex(path) {
  const file = await open(path);
  try {
    const reader = await McapIndexedReader.Initialize({ readable: readable(file), decompressHandlers });
    const counts = new Map([...reader.channelsById.keys()].map((id) => [id, 0]));
    for await (const { channelId } of reader.readMessages({ validateCrcs: true })) {
      counts.set(channelId, counts.get(channelId) + 1);
    }
    const topics = {};
    for (const [id, { topic }] of reader.channelsById) {
      const said = reader.statistics?.channelMessageCounts.get(id);
      if (said !== BigInt(counts.get(id))) throw new Error(`${topic}: ${said} messages by the statistics`);
      topics[topic] = (topics[topic] ?? 0) + counts.get(id);
    }
    for await (const _ of reader.readAttachments({ validateCrcs: true }));
    for await (const _ of reader.readMetadata());
    return topics;
  } finally {
    await file.close();
  }
}

async function read(path, cut) {
  const topics = readStream(await readFile(path), cut);
  if (!cut) {
    const listing = (pairs) => pairs.map(([topic, number]) => `${topic} ${number}`).sort().join(", ");
    const indexed = listing(Object.entries(await readIndex(path)));
    const found = listing(Object.entries(topics).map(([topic, seen]) => [topic, seen.count]));
    if (indexed !== found) throw new Error(`the index leads to ${indexed}; the file holds ${found}`);
  }
  for (const seen of Object.values(topics)) seen.newest = protojson.toJson(seen.newest.type, seen.newest.message);
  return topics;
}

const names = process.argv.slice(2);
const cut = names[0] === "--cut";
for (const path of names.slice(cut ? 1 : 0)) {
  try {
    console.log(JSON.stringify(await read(path, cut)));
  } catch (error) {
    console.error(`${path}: ${error.message}`);
    process.exitCode = 1;
    break;
  }
}
