// The sliders and buttons next to the picture.
const VIEWS = ["image", "labels over image", "labels", "depth"];
const LABELLED = [1, 2]; // views that show labels
const TINTS = ["#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442", "#b4b4b4"]; // as the rasteriser has them
const DEGREE = Math.PI / 180;

const element = (id) => document.getElementById(id);
const degrees = (v) => `${(v / DEGREE).toFixed(1)}°`;
const millimetres = (v) => `${v.toFixed(1)} mm`;

function made(tag, properties = {}, ...children) {
  const node = Object.assign(document.createElement(tag), properties);
  node.append(...children);
  return node;
}

function row(...children) {
  return made("div", { className: "row" }, ...children);
}

class Panel {
  constructor(page) {
    Object.assign(this, { page, head: page.head, sliders: [] });
    element("panel").append(this.recording(), ...this.head.instruments.map((item, index) => this.instrument(item, index)), this.picture());
    this.refresh();
  }

  recording() {
    const { page } = this, group = this.group("Recording"), last = page.last;
    this.slider(group, "frame", 0, last, 0.1, (v) => `${v.toFixed(1)} of ${last}`, () => page.wish.frame, (v) => page.toFrame(v));
    this.player = made("button", { textContent: "play", onclick: () => page.play() });
    this.follower = made("button", { textContent: "recorded camera", onclick: () => page.follow(!page.eye.follows) });
    group.append(row(this.player, this.follower));
    return group;
  }

  instrument(instrument, index) {
    const { page } = this, group = this.group(instrument.name), own = () => page.wish.instruments[index];
    instrument.joints.forEach((joint, j) => {
      const [low, high] = joint.range, show = joint.slides ? millimetres : degrees;
      const read = () => own().joints[j] ?? standings(this.head, page.wish)[index].readings[j];
      this.slider(group, joint.name, low, high, (high - low) / 200, show, read, (v) => { own().joints[j] = v; });
    });
    this.slider(group, "slide", -30, 30, 0.5, millimetres, () => own().slide, (v) => { own().slide = v; });
    for (const [name, most] of [["roll", 180], ["yaw", 30], ["pitch", 30]]) {
      this.slider(group, name, -most * DEGREE, most * DEGREE, 0.5 * DEGREE, degrees, () => own()[name], (v) => { own()[name] = v; });
    }
    group.append(row(made("button", { textContent: "as recorded", onclick: () => page.reset(index) })));
    return group;
  }

  picture() {
    const { page } = this, group = this.group("Picture");
    this.views = made("select", { id: "view", onchange: () => page.toView(Number(this.views.value)) });
    VIEWS.forEach((name, k) => { if (this.head.labels.length || !LABELLED.includes(k)) this.views.add(new Option(name, k)); });
    this.legend = made("div");
    this.head.labels.forEach(([name, part], k) => {
      const swatch = made("span", { className: "swatch" });
      swatch.style.background = TINTS[k % TINTS.length];
      this.legend.append(made("div", {}, swatch, `${name}: ${part.replaceAll("_", " ")}`));
    });
    const saves = this.head.labels.length ? ["image", "mask"] : ["image"];
    const buttons = saves.map((name) => made("button", { textContent: `save ${name}`, onclick: () => page.save(name) }));
    group.append(made("label", {}, "show", this.views), this.legend, row(...buttons));
    return group;
  }

  group(name) {
    return made("fieldset", {}, made("legend", { textContent: name }));
  }

  slider(group, name, low, high, step, written, read, write) {
    const spoken = name.replaceAll("_", " "), within = group.querySelector("legend").textContent;
    const input = made("input", { type: "range", min: low, max: high, step, name, ariaLabel: `${within}: ${spoken}` }), output = made("output");
    input.oninput = () => { write(Number(input.value)); this.page.moved(); };
    group.append(made("label", {}, spoken, output, input));
    this.sliders.push(() => { input.value = read(); input.ariaValueText = output.textContent = written(read()); });
  }

  // Shows the requested state.
  refresh() {
    const { page } = this;
    this.sliders.forEach((refresh) => refresh());
    this.views.value = page.wish.view;
    this.legend.hidden = !LABELLED.includes(page.wish.view);
    this.player.setAttribute("aria-pressed", page.playing);
    this.follower.setAttribute("aria-pressed", page.eye.follows);
  }
}
