// The camera: of a recorded frame, or turned by hand about the middle of the tissue, not far from where one was recorded.
const MOST_TURNED = Math.PI / 6; // from the nearest recorded camera
const FARTHEST_AWAY = 0.6; // of the way to the middle of the tissue, from the nearest recorded camera
const OBSERVED = 0.5; // of both: beyond, the page says that no frame observed what is shown

class Eye {
  // `changed` is called whenever a hand moves it.
  constructor(head, canvas, changed) {
    Object.assign(this, { head, canvas, changed, follows: true });
    this.atFrame(0);
    this.listen();
  }

  atFrame(frame) {
    this.matrix = this.recordedAt(frame);
    this.lens = this.head.recorded.lenses[neighbours(this.head, frame)[0]];
    this.home = this.reach = this.middleDepth();
  }

  recordedAt(frame) {
    const { cameras } = this.head.recorded, [k, l, share] = neighbours(this.head, frame);
    return between(cameras[k], cameras[l], share);
  }

  // How far a camera is from the nearest recorded one; 1: as far as a hand may move it.
  strayed(m) {
    return this.head.recorded.cameras.reduce((least, c) => {
      const turned = Math.acos(Math.min(1, m[2] * c[2] + m[6] * c[6] + m[10] * c[10]));
      const away = Math.hypot(m[3] - c[3], m[7] - c[7], m[11] - c[11]);
      return Math.min(least, Math.max(turned / MOST_TURNED, away / (FARTHEST_AWAY * this.home)));
    }, Infinity);
  }

  get unobserved() {
    return !this.follows && this.strayed(this.matrix) > OBSERVED;
  }

  // mm from the camera to the middle of the tissue.
  middleDepth() {
    const [low, high] = this.head.ranges.mean[0], m = this.matrix;
    const depth = [0, 1, 2].reduce((sum, i) => sum + m[4 * i + 2] * ((low[i] + high[i]) / 2 - m[4 * i + 3]), 0);
    return Math.max(10, depth);
  }

  // The recorded image, larger or smaller.
  lensAt(scale) {
    const [fx, fy, cx, cy, w, h, near] = this.lens;
    const width = Math.max(1, Math.round(w * scale)), height = Math.max(1, Math.round(h * scale));
    return { lens: [(fx * width) / w, (fy * height) / h, (cx * width) / w, (cy * height) / h], width, height, near };
  }

  listen() {
    const fingers = new Map(), canvas = this.canvas;
    const apart = () => { const [a, b] = [...fingers.values()]; return Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY); };
    canvas.onpointerdown = (event) => { canvas.setPointerCapture(event.pointerId); fingers.set(event.pointerId, event); };
    canvas.onpointerup = canvas.onpointercancel = (event) => fingers.delete(event.pointerId);
    canvas.onpointermove = (event) => {
      const before = fingers.get(event.pointerId);
      if (!before) return;
      const dx = event.clientX - before.clientX, dy = event.clientY - before.clientY, spread = fingers.size === 2 ? apart() : 0;
      fingers.set(event.pointerId, event);
      if (fingers.size === 2) {
        this.nearer(Math.log(apart() / spread));
        this.shift(dx / 2, dy / 2);
      } else if (event.shiftKey || event.buttons & 2) this.shift(dx, dy);
      else this.orbit(dx, dy);
    };
    canvas.oncontextmenu = (event) => event.preventDefault();
    canvas.onwheel = (event) => { event.preventDefault(); this.nearer(-0.001 * event.deltaY); };
  }

  // Moves there and returns true, unless that leads farther away from what was recorded.
  move(matrix) {
    const away = this.strayed(matrix);
    if (away > 1 && away > this.strayed(this.matrix)) return false;
    this.matrix = matrix;
    this.changed();
    return true;
  }

  orbit(dx, dy) {
    const m = this.matrix, at = [0, 1, 2].map((i) => m[4 * i + 3] + this.reach * m[4 * i + 2]);
    this.move(multiply(about(at, [m[0], m[4], m[8]], -0.005 * dy), multiply(about(at, [m[1], m[5], m[9]], 0.005 * dx), m)));
  }

  shift(dx, dy) {
    const pixel = (this.reach / this.lens[0]) * (this.lens[4] / this.canvas.clientWidth); // mm
    this.move(multiply(this.matrix, shifted([-dx * pixel, -dy * pixel, 0])));
  }

  nearer(by) {
    const way = this.reach * (1 - Math.exp(-by));
    if (this.move(multiply(this.matrix, shifted([0, 0, way])))) this.reach -= way;
  }
}
