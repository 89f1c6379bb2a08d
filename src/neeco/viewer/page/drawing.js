// Shares the rows of an image among workers, one image at a time.
const ROWS = 32; // of a band at least: the height of a tile

function asked(worker, message) {
  return new Promise((done, fail) => {
    worker.onmessage = ({ data }) => (data.failed === undefined ? done(data) : fail(new Error(data.failed)));
    worker.onerror = (event) => fail(new Error(event.message));
    worker.postMessage(message);
  });
}

class Drawing {
  constructor(workers) {
    this.workers = workers;
    this.job = 0;
  }

  static async begin(scene, wasm, source, count) {
    const module = await WebAssembly.compile(wasm);
    const workers = [...Array(count)].map(() => new Worker(source));
    await Promise.all(workers.map((worker) => asked(worker, { wasm: module, size: scene.size, inputs: scene.inputs })));
    return new Drawing(workers);
  }

  // Drops the bands still to be rendered.
  drop() {
    this.job++;
  }

  // The answers of all bands, or null where it was dropped.
  async draw(wish) {
    const job = ++this.job, bands = this.bands(wish.height), answers = [];
    const work = async (worker) => {
      while (bands.length && job === this.job) {
        const [from, to] = bands.shift();
        answers.push(await asked(worker, { job, wish, from, to }));
      }
    };
    await Promise.all(this.workers.map(work));
    return job === this.job ? answers : null;
  }

  // Several for every worker, for some are fuller than others; none where one worker does it all.
  bands(height) {
    const count = this.workers.length === 1 ? 1 : 2 * this.workers.length;
    const rows = Math.max(ROWS, Math.ceil(height / count / ROWS) * ROWS), found = [];
    for (let from = 0; from < height; from += rows) found.push([from, Math.min(height, from + rows)]);
    return found;
  }
}
