// Print each change of the contact mode, without softfinger.
//
//     npm install                                 // in this folder: zeromq and @msgpack/msgpack
//     node subscribe.mjs                          // tcp://127.0.0.1:5555, forever
//     node subscribe.mjs ipc:///run/softfinger 4  // another endpoint, four changes
import { decode } from "@msgpack/msgpack";
import { Subscriber } from "zeromq";

const [endpoint = "tcp://127.0.0.1:5555", changes = "Infinity"] = process.argv.slice(2);
const modes = ["free", "rolling", "sliding"];

const socket = new Subscriber();
socket.connect(endpoint);
socket.subscribe("contact");

let mode;
let left = Number(changes);
for await (const [, body] of socket) {
  const message = decode(body);
  if (message.contact.mode === mode) continue;
  mode = message.contact.mode;
  const force = message.force.map((component) => (Math.round(1e3 * component) / 1e3 + 0).toFixed(3)); // without -0.000
  console.log(message.tick, modes[mode], ...force);
  if (--left <= 0) break;
}
socket.close();
