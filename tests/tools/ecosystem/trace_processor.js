// The trace processor of Perfetto's user interface, compiled to WebAssembly, as a filter: requests of its RPC protocol
// come on standard input, and answers go to standard output. Argument: the folder of the user interface.
const fs = require("fs");
const path = require("path");
const vm = require("vm");

const read = (name) => fs.readFileSync(path.join(process.argv[2], path.basename(name)));
const port = { postMessage: (data) => fs.writeSync(1, data) };
const self = { location: { href: "http://localhost/" } };

class XMLHttpRequest {
  open(method, name) { this.name = name; }
  send() { this.response = new Uint8Array(read(this.name)).buffer; }
}

// Without `process`, the program takes this for a worker of a browser.
const names = { self, location: self.location, XMLHttpRequest, WorkerGlobalScope: Object, WebAssembly, TypeError, RangeError,
  Uint8Array, ArrayBuffer, TextDecoder, URL, crypto, performance, setTimeout, console: { log() {}, warn() {}, error() {} } };
vm.runInNewContext(read("engine_bundle.js").toString(), names);
self.onmessage({ data: port });
process.stdin.on("data", (chunk) => port.onmessage({ data: new Uint8Array(chunk) }));
