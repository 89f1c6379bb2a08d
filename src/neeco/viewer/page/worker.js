// Has the whole scene and renders rows of the image, one request after the other; the page keeps several of these.
let api, scene;

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
  scene = { means: inputs[0], sh: inputs[4], falloff: inputs[5], body: inputs[8] };
  api.lit();
}

const SH_C0 = 0.28209479177387814;
let posed = 0, lit = false; // lit: from elsewhere than the camera

// The kernel's light stands at the camera. Where a hand moved that, every Gaussian's colour is scaled to the light that it gets from
// the recorded camera: the picture keeps its exposure.
function light(wish) {
  const [c, l] = [wish.matrix, wish.light].map((m) => [m[3], m[7], m[11]]);
  const moved = c.some((x, k) => x !== l[k]);
  if (!moved && !lit) return;
  lit = moved;
  const { means, sh, falloff, body } = scene, n = body.length, width = sh.length / n, out = view(Float32Array, api.input(4), sh.length);
  out.set(sh);
  for (let i = 0; moved && i < n; i++) {
    const pose = 16 * (body[i] - 1), p = means.subarray(3 * i, 3 * i + 3);
    let near = 0, far = 0; // squared distances; an open jaw's is that of a closed one
    for (let k = 0; k < 3; k++) {
      const row = pose + 4 * k, s = wish.state;
      const x = body[i] ? s[row] * p[0] + s[row + 1] * p[1] + s[row + 2] * p[2] + s[row + 3] : p[k];
      near += (x - c[k]) ** 2;
      far += (x - l[k]) ** 2;
    }
    const gain = (near / far) ** (falloff[i] / 2);
    for (let k = 0; k < width; k++) out[width * i + k] = gain * sh[width * i + k] + (k < 3 ? ((gain - 1) * 0.5) / SH_C0 : 0);
  }
}

function draw({ job, wish, from, to }) {
  const { lens, width, height, near } = wish;
  if (job !== posed) {
    view(Float32Array, api.input(10), wish.state.length).set(wish.state);
    view(Float32Array, api.input(11), 12).set(wish.light);
    api.pose();
    api.shade(...lens, width, height, near);
    view(Float32Array, api.input(11), 12).set(wish.matrix);
    light(wish);
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
