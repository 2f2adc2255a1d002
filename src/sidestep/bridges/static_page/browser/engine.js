// The translated program: typed views of its memory by name, and its functions. It needs nothing but Math.

export function singles(names) {
  const { fround } = Math;
  const made = Object.fromEntries(names.map((name) => [name, (a, b) => fround(Math[name](a, b))]));
  made.rem = (a, b) => fround(a % b);
  return made;
}

async function fetched(url) {
  const answer = await fetch(url);
  if (!answer.ok) throw new Error(`${url}: ${answer.status}`);
  return answer;
}

// The module, unpacked unless the web server has done so.
async function code(url) {
  const bytes = new Uint8Array(await (await fetched(url)).arrayBuffer());
  if (bytes[0] !== 0x1f) return bytes;
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

export class Engine {
  constructor(exports, areas) {
    this.exports = exports;
    this.areas = {};
    for (const [name, [address, kind, shape]] of Object.entries(areas)) {
      const View = kind === "f" ? Float32Array : Int32Array;
      const size = shape.reduce((a, b) => a * b, 1);
      this.areas[name] = new View(exports.memory.buffer, address, size);
    }
    this.shapes = Object.fromEntries(Object.entries(areas).map(([name, [, , shape]]) => [name, shape]));
  }

  // What the page has to know, and the engine.
  static async load() {
    const at = (name) => new URL(name, import.meta.url).href;
    const [about, bytes] = await Promise.all([
      fetched(at("page.json")).then((answer) => answer.json()), code(at("engine.bin"))]);
    const { instance } = await WebAssembly.instantiate(bytes, { math: singles(about.imports) });
    return [about, new Engine(instance.exports, about.areas)];
  }

  run(name) {
    this.exports[name]();
  }

  has(name) {
    return name in this.exports;
  }

  // Numbers of an area: a number, a list, or a list of rows, as its shape says.
  get(name) {
    const values = this.areas[name];
    const shape = this.shapes[name];
    if (shape.length === 0) return values[0];
    if (shape.length === 1) return [...values];
    return Array.from({ length: shape[0] }, (_, i) => [...values.subarray(i * shape[1], (i + 1) * shape[1])]);
  }

  set(name, ...values) {
    this.areas[name].set(values.flat(2).map(Number));
  }
}
