// rotorwatch.wasm in JavaScript: assess(await WebAssembly.compile(code), bytes, "flight.ulg") gives the answer of rw_assess_log as an object.
// As a command: node rotorwatch.mjs flight.ulg

// begin
async function assess(module, data, name) {
  // Nothing of the outside is lent to it; an instance of its own for each log gives its memory back.
  const lent = WebAssembly.Module.imports(module).map((one) => [one.name, () => 52]); // WASI's "not supported"
  const { exports: c } = await WebAssembly.instantiate(module, { wasi_snapshot_preview1: Object.fromEntries(lent) });
  c._initialize?.();
  const put = (bytes) => {
    const at = c.malloc(bytes.length + 1);
    if (!at) throw new Error("there is not enough memory for this log");
    new Uint8Array(c.memory.buffer).set(bytes, at);
    return at;
  };
  const label = put(new TextEncoder().encode(name + "\0"));
  const at = c.rw_assess_log(put(data), data.length, label);
  if (!at) throw new Error("there is not enough memory for this log");
  const bytes = new Uint8Array(c.memory.buffer);
  return JSON.parse(new TextDecoder().decode(bytes.slice(at, bytes.indexOf(0, at))));
}
// end

export { assess };

if (typeof process !== "undefined" && process.argv[1]?.endsWith("rotorwatch.mjs")) {
  const { readFileSync } = await import("node:fs");
  const { basename } = await import("node:path");
  const [log] = process.argv.slice(2);
  const module = await WebAssembly.compile(readFileSync(new URL("rotorwatch.wasm", import.meta.url)));
  const answer = log ? await assess(module, readFileSync(log), basename(log)) : { error: "give one log" };
  console.log(JSON.stringify(answer));
  if (answer.error) {
    console.error(`${log ?? "rotorwatch.mjs"}: ${answer.error}`);
    process.exitCode = 2;
  }
}
