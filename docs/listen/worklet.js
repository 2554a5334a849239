// The control loop on the browser's audio thread: an error to hear, and the disturbance beside it.
class Loop extends AudioWorkletProcessor {
  constructor({ processorOptions: { wasm, scene } }) {
    super();
    this.core = new WebAssembly.Instance(new WebAssembly.Module(wasm)).exports;
    this.core._initialize();
    this.blocks = 0;
    this.set(scene, true);
    this.port.onmessage = ({ data }) => {
      if (data.scene) this.set(data.scene, data.afresh);
      else this.core.player_rate(data.rated);
    };
  }

  buffer(which, length) {
    return new Float32Array(this.core.memory.buffer, this.core.player_buffer(which), length);
  }

  set(scene, afresh) {
    this.noise = scene.noise;
    if (afresh) this.position = 0;
    [scene.primary, scene.secondary, scene.settings].forEach((numbers, k) => this.buffer(k, numbers.length).set(numbers));
    const { which, taps, primary, secondary, rated, rate } = scene;
    const opened = this.core.player_open(which, taps, primary.length, secondary.length, rated, rate, afresh ? 1 : 0);
    this.port.postMessage({ refused: !opened });
    this.opened = Boolean(opened);
  }

  process(_, [[error], [disturbance]]) {
    if (!this.opened) return true;
    const heard = this.buffer(3, error.length);
    for (let k = 0; k < error.length; k++) {
      heard[k] = this.noise[this.position];
      this.position = (this.position + 1) % this.noise.length;
    }
    this.core.player_run(error.length);
    error.set(this.buffer(4, error.length));
    disturbance?.set(this.buffer(5, error.length));
    this.blocks += 1;
    if (this.blocks % 10 === 0) {
      const [d, e, y, factor, status] = [0, 1, 2, 3, 4].map((which) => this.core.player_number(which));
      this.port.postMessage({ d, e, y, factor, status, samples: 10 * error.length });
      this.core.player_forget();
    }
    return true;
  }
}
registerProcessor("loop", Loop);
