// Runs a function of a module for many states: node wasm_host.mjs MODULE JOB INPUTS OUTPUTS, numbers in single precision.
import fs from "node:fs";

const [, , path, job, given, wanted] = process.argv;
const { imports, name, inputs, outputs } = JSON.parse(fs.readFileSync(job));
const math = Object.fromEntries(imports.map((one) => [one, (a, b) => Math.fround(Math[one](a, b))]));
math.rem = (a, b) => Math.fround(a % b);
const { instance } = await WebAssembly.instantiate(fs.readFileSync(path), { math });
const { memory } = instance.exports;
const view = ([address, kind, size]) => new (kind === "f" ? Float32Array : Int32Array)(memory.buffer, address, size);
const read = inputs.map(view);
const written = outputs.map(view);
const bytes = fs.readFileSync(given);
const states = new Float32Array(bytes.buffer, bytes.byteOffset, bytes.length / 4);
const width = read.reduce((sum, part) => sum + part.length, 0);
const found = [];
for (let at = 0; at < states.length; at += width) {
  let from = at;
  for (const part of read) part.set(states.subarray(from, (from += part.length)));
  instance.exports[name]();
  for (const part of written) found.push(...part);
}
fs.writeFileSync(wanted, Buffer.from(new Float32Array(found).buffer));
