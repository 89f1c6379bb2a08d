// The page: the requested state and view, and the loop that renders it small while something moves and sharp once it rests.
const STILL_MS = 150; // without a change, after which it is rendered sharp
const SHARPEST = 2; // times the recorded size
const BUDGET_MS = 60; // of a rendering while something moves; above that it is rendered smaller
const SMALLEST = 0.75;
const NEAREST = 0.3, FARTHEST = 1.3; // of the way to the middle of the tissue: white and black where depth is shown
const FRAMES_A_SECOND = 10; // of playing

class Page {
  constructor(scene, drawing) {
    Object.assign(this, { head: scene.head, drawing, canvas: element("canvas"), drawn: 0, took: 0, scale: 1, playing: false });
    this.context = this.canvas.getContext("2d");
    this.last = this.head.recorded.names.length - 1;
    this.wish = { frame: 0, view: 0, instruments: this.head.instruments.map(asRecorded) };
    this.eye = new Eye(this.head, this.canvas, () => { this.eye.follows = false; this.moved(); });
    this.panel = new Panel(this);
    window.onresize = () => { this.fit(); this.moved(); };
    window.onkeydown = (event) => this.key(event);
    this.canvas.ondblclick = () => this.follow(true);
    this.fit();
    this.moved(-STILL_MS); // the first picture is a sharp one
  }

  moved(later = 0) {
    this.changed = performance.now() + later;
    this.settled = false;
    this.panel.refresh();
    if (this.sharpening) this.drawing.drop();
    if (!this.busy) this.loop();
  }

  async loop() {
    this.busy = true;
    while (!this.settled) {
      const asked = this.changed, wait = STILL_MS - (performance.now() - asked);
      if (wait > 0) {
        await this.show(this.scale);
        await (asked === this.changed ? new Promise((done) => { setTimeout(done, Math.max(0, wait - this.took)); }) : new Promise(requestAnimationFrame));
      } else {
        this.sharpening = true;
        this.settled = (await this.show(this.sharpScale())) && asked === this.changed;
        this.sharpening = false;
      }
    }
    this.busy = false;
  }

  sharpScale() {
    const shown = this.canvas.getBoundingClientRect().width * (window.devicePixelRatio || 1);
    return Math.max(1, Math.min(SHARPEST, shown / this.eye.lens[4]));
  }

  wished(scale, show, all) {
    const depths = [NEAREST * this.eye.reach, FARTHEST * this.eye.reach];
    const [matrix, light] = [this.eye.matrix, this.eye.recordedAt(this.wish.frame)].map((rows) => Float32Array.from(rows));
    return { ...this.eye.lensAt(scale), state: packedState(this.head, this.wish), matrix, light, show, depths, all };
  }

  // Renders and shows; false where it was dropped on the way.
  async show(scale) {
    const began = performance.now(), wish = this.wished(scale, this.wish.view, false);
    const bands = await this.drawing.draw(wish);
    if (!bands) return false;
    this.took = performance.now() - began;
    if (!this.sharpening) this.scale = Math.min(this.sharpScale(), Math.max(SMALLEST, scale * Math.sqrt(BUDGET_MS / this.took)));
    put(bands, this.canvas, wish);
    this.drawn++;
    element("unobserved").hidden = !this.eye.unobserved;
    const [k] = neighbours(this.head, this.wish.frame);
    element("said").textContent = `${this.head.recorded.names[k]} · ${wish.width}x${wish.height} · ${this.took.toFixed(0)} ms`;
    return true;
  }

  toFrame(frame) {
    this.wish.frame = Math.max(0, Math.min(this.last, frame));
    if (this.eye.follows) this.eye.atFrame(this.wish.frame);
    this.moved();
  }

  toView(view) {
    this.wish.view = view;
    this.moved();
  }

  reset(index) {
    this.wish.instruments[index] = asRecorded();
    this.moved();
  }

  follow(on) {
    this.eye.follows = on;
    if (on) this.eye.atFrame(this.wish.frame);
    this.moved();
  }

  play() {
    this.playing = !this.playing;
    let before = performance.now();
    const go = (now) => {
      if (!this.playing) return;
      this.toFrame(this.wish.frame >= this.last ? 0 : this.wish.frame + ((now - before) / 1000) * FRAMES_A_SECOND);
      before = now;
      requestAnimationFrame(go);
    };
    if (this.playing) requestAnimationFrame(go);
    this.panel.refresh();
  }

  // A rendering of the recorded size, once nothing else is rendered: {width, height, pixels (RGBA), ids, depths (mm)}.
  async whole(view) {
    while (this.busy) await new Promise((done) => { setTimeout(done, 10); });
    this.busy = true;
    const wish = this.wished(1, view, true), bands = await this.drawing.draw(wish);
    this.busy = false;
    this.moved();
    const { width, height } = wish, size = width * height;
    const all = { width, height, pixels: new Uint8ClampedArray(4 * size), ids: new Uint8Array(size), depths: new Float32Array(size) };
    for (const { from, pixels, ids, depths } of bands) {
      all.pixels.set(pixels, 4 * width * from);
      all.ids.set(ids, width * from);
      all.depths.set(depths, width * from);
    }
    return all;
  }

  async save(name) {
    const { width, height, pixels, ids } = await this.whole(name === "mask" ? 2 : 0), canvas = made("canvas");
    if (name === "mask") ids.forEach((id, i) => pixels.set(id ? [255, 255, 255, 255] : [0, 0, 0, 255], 4 * i));
    put([{ pixels, from: 0, to: height }], canvas, { width, height });
    const blob = await new Promise((done) => { canvas.toBlob(done, "image/png"); }), href = URL.createObjectURL(blob);
    made("a", { href, download: `${document.title}-${name}.png` }).click();
    setTimeout(() => URL.revokeObjectURL(href), 1000);
  }

  key(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || ["SELECT", "INPUT", "BUTTON"].includes(event.target.tagName)) return;
    const views = [...this.panel.views.options].map((option) => Number(option.value));
    const acts = {
      arrowleft: () => this.toFrame(Math.ceil(this.wish.frame) - 1),
      arrowright: () => this.toFrame(Math.floor(this.wish.frame) + 1),
      " ": () => this.play(),
      c: () => this.follow(true),
      r: () => {
        this.head.instruments.forEach((item, index) => this.reset(index));
        this.follow(true);
      },
      v: () => this.toView(views[(views.indexOf(this.wish.view) + 1) % views.length]),
    };
    const act = acts[event.key.toLowerCase()];
    if (!act) return;
    event.preventDefault();
    act();
  }

  fit() {
    const [, , , , w, h] = this.eye.lens, stage = element("stage"), phone = matchMedia("(max-width: 720px)").matches;
    const scale = Math.min(stage.clientWidth / w, (phone ? 0.5 * window.innerHeight : stage.clientHeight) / h);
    this.canvas.style.width = `${Math.floor(w * scale)}px`;
    this.canvas.style.height = `${Math.floor(h * scale)}px`;
  }
}

function asRecorded() {
  return { joints: {}, slide: 0, roll: 0, yaw: 0, pitch: 0 };
}

function put(bands, canvas, { width, height }) {
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  const context = canvas.getContext("2d");
  for (const { pixels, from, to } of bands) context.putImageData(new ImageData(pixels, width, to - from), 0, from);
}

async function begin() {
  const scene = await loadScene();
  const wasm = await inflated("wasm");
  const source = URL.createObjectURL(new Blob([element("worker").textContent], { type: "text/javascript" }));
  const workers = Math.max(1, Math.min(4, navigator.hardwareConcurrency || 2));
  window.neeco = new Page(scene, await Drawing.begin(scene, wasm, source, workers)); // for scripts that drive the page
}

function fail(error) {
  element("failed").hidden = false;
  element("failed").textContent = `This page could not be rendered here: ${error.message}`;
  element("said").textContent = "";
}

window.onunhandledrejection = (event) => fail(event.reason);
begin().catch(fail);
