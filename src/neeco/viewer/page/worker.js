// Has the whole scene and renders rows of the image, one request after the other; the page keeps several of these.
let api;

function view(type, at, length) {
  return new type(api.memory.buffer, at, length); // made anew: the memory may have grown
}

async function begin({ wasm, size, inputs }) {
  const clock = (id, precision, at) => { new DataView(api.memory.buffer).setBigUint64(at, BigInt(Math.round(performance.now() * 1e6)), true); return 0; };
  const refused = () => 8;
  const system = { fd_close: refused, fd_seek: refused, fd_write: refused, clock_time_get: clock };
  api = (await WebAssembly.instantiate(wasm, { wasi_snapshot_preview1: system })).exports;
  api._initialize();
  api.begin(...size);
  inputs.forEach((array, which) => view(array.constructor, api.input(which), array.length).set(array));
  api.lit();
}

let posed = 0;

function draw({ job, wish, from, to }) {
  const { lens, width, height, near } = wish;
  if (job !== posed) {
    view(Float32Array, api.input(10), wish.state.length).set(wish.state);
    view(Float32Array, api.input(11), 12).set(wish.matrix);
    api.pose();
    api.shade(...lens, width, height, near);
    posed = job;
  }
  const at = api.draw(...lens, width, height, from, to, near, wish.show, wish.depths[0], wish.depths[1]);
  const size = width * (to - from);
  const answer = { job, from, to, pixels: view(Uint8ClampedArray, at, 4 * size).slice() };
  if (wish.all) Object.assign(answer, { ids: view(Int32Array, api.ids(), size).slice(), depths: view(Float32Array, api.depths(), size).slice() });
  return answer;
}

onmessage = async ({ data }) => {
  try {
    if (data.wasm) {
      await begin(data);
      postMessage({ ready: true });
      return;
    }
    const answer = draw(data);
    postMessage(answer, [answer.pixels.buffer]);
  } catch (error) {
    postMessage({ failed: error.message });
  }
};
