// The page on which one hears a controller: controls, figures, and the visitor's own files. LISTEN holds what Python made.
(() => {
  const place = document.getElementById("listen");
  const TAPS = 128, LEAST_DB = -3, MOST_DB = 12, SHOWN_S = 20, LOUDNESS = 0.08;

  const bytes = (base64) => Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  const WASM = bytes(LISTEN.wasm).buffer;

  // Signals.

  function builtIn() {
    const noise = Float32Array.from(new Int16Array(bytes(LISTEN.noise).buffer), (sample) => sample / 32768);
    return { fs: LISTEN.fs, noise, primary: Float32Array.from(LISTEN.primary), secondary: Float32Array.from(LISTEN.secondary) };
  }

  const power = (x) => x.reduce((sum, sample) => sum + sample * sample, 0) / x.length;

  function filtered(taps, x, length) {
    const y = new Float64Array(Math.min(length, x.length));
    for (let n = 0; n < y.length; n++)
      for (let k = 0; k < taps.length && k <= n; k++) y[n] += taps[k] * x[n - k];
    return y;
  }

  // Powers of the noise, the disturbance, and the control signal that would cancel it if the path were flat.
  function measured({ fs, noise, primary, secondary }) {
    const x = power(noise), d = power(filtered(primary, noise, fs)), f = power(filtered(secondary, noise, fs));
    return { x, d, full: (d * x) / f };
  }

  // The first channel of a WAV file as it is: no sample is changed, and none is resampled.
  function readWav(buffer, name) {
    const view = new DataView(buffer), word = (at) => String.fromCharCode(...new Uint8Array(buffer, at, 4));
    const refuse = (why) => { throw new Error(`${name}: ${why}. Save it as WAV with 16, 24 or 32 bits.`); };
    if (buffer.byteLength < 44 || word(0) !== "RIFF" || word(8) !== "WAVE") refuse("this is no WAV file");
    let format = null;
    for (let at = 12; at + 8 <= buffer.byteLength; ) {
      const kind = word(at), size = view.getUint32(at + 4, true), body = at + 8;
      if (kind === "fmt ") {
        const tag = view.getUint16(body, true);
        format = {
          float: (tag === 0xfffe ? view.getUint16(body + 24, true) : tag) === 3,
          channels: view.getUint16(body + 2, true), fs: view.getUint32(body + 4, true),
          block: view.getUint16(body + 12, true), bits: view.getUint16(body + 14, true),
        };
      } else if (kind === "data") {
        if (!format || !format.block) refuse("it has no format");
        const { bits, float, channels } = format;
        if (format.block * 8 !== bits * channels) refuse(`${bits} bits in blocks of ${format.block} bytes are not read here`);
        const read = float
          ? { 32: (k) => view.getFloat32(k, true), 64: (k) => view.getFloat64(k, true) }[bits]
          : {
              16: (k) => view.getInt16(k, true) / 2 ** 15,
              24: (k) => (view.getUint8(k) + 256 * view.getUint8(k + 1) + 65536 * view.getInt8(k + 2)) / 2 ** 23,
              32: (k) => view.getInt32(k, true) / 2 ** 31,
            }[bits];
        if (!read) refuse(`${bits} bits are not read here`);
        const count = Math.floor(Math.min(size, buffer.byteLength - body) / format.block);
        const samples = Float32Array.from({ length: count }, (_, k) => read(body + k * format.block));
        if (!count || !samples.every(Number.isFinite) || !samples.some(Boolean)) refuse("it is empty, silent or not finite");
        return { fs: format.fs, samples };
      }
      at = body + size + (size % 2);
    }
    return refuse("it has no samples");
  }

  // The settings of a controller by their names, by the same rules for every noise.
  function sceneOf(signals, name, levelDb) {
    const { which, settings } = LISTEN.controllers[name], { x, d, full } = signals.powers, rates = LISTEN.rates[signals.fs];
    const rated = full / 10 ** (levelDb / 10), q = 1e-3 * d;
    const known = {
      ...LISTEN.defaults, ...rates, rated_power: rated,
      measurement_noise: q, state_noise: 1e-8 * q, initial_variance: full / (TAPS * x),
    };
    return { ...signals, which, taps: TAPS, rated, rate: rates.rate, settings: settings.map((setting) => known[setting]) };
  }

  // Audio.

  async function loopIn(context, scene) {
    await context.audioWorklet.addModule(`data:text/javascript;base64,${btoa(LISTEN.worklet)}`);
    return new AudioWorkletNode(context, "loop", {
      numberOfInputs: 0, numberOfOutputs: 2, outputChannelCount: [1, 1], processorOptions: { wasm: WASM, scene },
    });
  }

  function prepared(signals) {
    if (!LISTEN.rates[signals.fs]) throw new Error(`${signals.fs} Hz is not among the sample rates of this page: ${Object.keys(LISTEN.rates).join(", ")} Hz.`);
    return { ...signals, powers: measured(signals) };
  }

  // Render some seconds without playing them, for a comparison with Python.
  async function render(name, levelDb, seconds) {
    const signals = prepared(builtIn());
    const context = new OfflineAudioContext(1, Math.round(seconds * signals.fs), signals.fs);
    (await loopIn(context, sceneOf(signals, name, levelDb))).connect(context.destination, 0);
    return (await context.startRendering()).getChannelData(0);
  }
  window.kfopcListen = { render, readWav, sceneOf: (name, levelDb) => sceneOf(prepared(builtIn()), name, levelDb) };

  const lacking = [
    ["WebAssembly", typeof WebAssembly !== "undefined"],
    ["AudioWorklet", typeof AudioWorkletNode !== "undefined"],
  ].filter(([, there]) => !there);
  if (lacking.length) {
    place.textContent = `Your browser lacks ${lacking.map(([name]) => name).join(" and ")}, which this page needs.`;
    return;
  }

  // The page.

  place.innerHTML = `
    <div class="listen-row"><button id="listen-play">Play</button>
      ${Object.keys(LISTEN.controllers).map((name) => `<label><input type="radio" name="listen-controller" value="${name}"> ${name}</label>`).join(" ")}</div>
    <div class="listen-row"><label>Too loud for the amplifier by <input type="range" id="listen-level" min="${LEAST_DB}" max="${MOST_DB}" step="0.5" value="6">
      <output id="listen-level-db"></output></label></div>
    <canvas id="listen-figure" width="760" height="420"></canvas>
    <p id="listen-said" role="status"></p>
    <details><summary>Your own noise and impulse responses</summary>
      ${["noise", "primary", "secondary"].map((name) => `<label>${name === "noise" ? "Noise at the reference" : `${name[0].toUpperCase() + name.slice(1)} path`} <input type="file" accept=".wav" id="listen-${name}"></label>`).join("<br>")}
      <p>WAV files with the same sample rate; the first channel counts. Without impulse responses, those of the built-in duct are used,
      as if sampled at the noise's rate. Nothing leaves this page.</p></details>`;
  const at = (name) => document.getElementById(`listen-${name}`);
  const said = (text) => { at("said").textContent = text; };
  place.querySelector('input[value="KF-OPC"]').checked = true;

  let signals = prepared(builtIn()), playing = null, history = [];
  const chosen = () => place.querySelector("input[name=listen-controller]:checked").value;
  const scene = () => sceneOf(signals, chosen(), Number(at("level").value));
  const showLevel = () => { at("level-db").textContent = `${at("level").value} dB`; };

  async function play() {
    const context = new AudioContext({ sampleRate: signals.fs }), now = scene();
    const loop = await loopIn(context, now), gain = context.createGain();
    const [error, disturbance] = [0, 1].map((output) => {
      const analyser = context.createAnalyser();
      Object.assign(analyser, { fftSize: 1024, smoothingTimeConstant: 0.9, minDecibels: -140 });
      loop.connect(analyser, output);
      return analyser;
    });
    gain.gain.value = LOUDNESS / Math.sqrt(signals.powers.d);
    error.connect(gain).connect(context.destination);
    loop.port.onmessage = ({ data }) => {
      if (data.refused) said("This controller does not fit: the paths are too long for it.");
      else if (data.samples) history.push(data);
      while (history.length * (data.samples || 1) > SHOWN_S * signals.fs) history.shift();
    };
    playing = { context, loop, error, disturbance, rated: now.rated };
    await context.resume();
    at("play").textContent = "Stop";
    requestAnimationFrame(draw);
  }

  async function stop() {
    const { context } = playing;
    playing = null;
    at("play").textContent = "Play";
    await context.close();
  }

  function change(afresh = false) {
    showLevel();
    if (!playing) return;
    const now = scene();
    playing.rated = now.rated;
    playing.loop.port.postMessage({ scene: now, afresh });
  }

  // Figures: the spectra, and the control power over the rating.

  const COLOURS = { before: "#999999", error: "#d55e00", power: "#0072b2", line: "#555555" };
  const figure = at("figure").getContext("2d");

  function axes(left, top, width, height, title, low, high, step, unit) {
    figure.fillStyle = figure.strokeStyle = COLOURS.line;
    figure.lineWidth = 0.5;
    figure.font = "13px sans-serif";
    figure.fillText(title, left, top - 8);
    const y = (value) => top + height * (1 - (Math.min(Math.max(value, low), high) - low) / (high - low));
    for (let value = low; value <= high; value += step) {
      figure.fillText(`${value}${unit}`, left - 46, y(value) + 4);
      figure.beginPath(), figure.moveTo(left, y(value)), figure.lineTo(left + width, y(value)), figure.stroke();
    }
    return y;
  }

  function ticks(left, top, width, texts) {
    figure.fillStyle = COLOURS.line;
    texts.forEach((text, k) => {
      figure.textAlign = k === 0 ? "left" : k === texts.length - 1 ? "right" : "center";
      figure.fillText(text, left + (width * k) / (texts.length - 1), top + 16);
    });
    figure.textAlign = "left";
  }

  function curve(points, colour, width = 1.5) {
    figure.strokeStyle = colour;
    figure.lineWidth = width;
    figure.beginPath();
    points.forEach(([x, y], k) => (k ? figure.lineTo(x, y) : figure.moveTo(x, y)));
    figure.stroke();
  }

  function draw() {
    if (!playing) return;
    const { error, disturbance, rated } = playing, [left, width] = [60, 690];
    figure.fillStyle = "#ffffff";
    figure.fillRect(0, 0, 760, 420);
    const spectra = [disturbance, error].map((analyser) => {
      const values = new Float32Array(analyser.frequencyBinCount);
      analyser.getFloatFrequencyData(values);
      return values.subarray(0, Math.floor((2000 / (signals.fs / 2)) * values.length) || values.length);
    });
    const peak = Math.max(-100, ...spectra[0]);
    const level = axes(left, 30, width, 150, "Spectrum at the microphone: noise (grey), error (orange)", -60, 0, 20, " dB");
    const shown = Math.min(2000, signals.fs / 2);
    ticks(left, 180, width, [0, 1, 2, 3, 4].map((k) => `${(shown * k) / 4} Hz`));
    spectra.forEach((values, k) =>
      curve(Array.from(values, (value, n) => [left + (width * n) / values.length, level(value - peak)]), k ? COLOURS.error : COLOURS.before));
    const ratio = axes(left, 240, width, 150, "Last 20 s: control power over the rating (blue), error over noise (orange)", -20, 40, 20, " dB");
    ticks(left, 390, width, [0, 1, 2, 3, 4].map((k) => `${(SHOWN_S * k) / 4} s`));
    const x = (n) => left + (width * n * (history[0]?.samples ?? 1)) / (SHOWN_S * signals.fs);
    const db = (value) => 10 * Math.log10(Math.max(value, 1e-6));
    curve([[left, ratio(0)], [left + width, ratio(0)]], COLOURS.line);
    curve(history.map(({ y, samples }, n) => [x(n), ratio(db(y / samples / rated))]), COLOURS.power);
    curve(history.map(({ e, d }, n) => [x(n), ratio(db(e / d))]), COLOURS.error);
    const recent = history.slice(-Math.ceil(signals.fs / (history[0]?.samples ?? 1)));
    if (recent.length) {
      const sum = (name) => recent.reduce((all, one) => all + one[name], 0), { factor, status } = recent.at(-1);
      const parts = [
        `noise reduction ${(-db(sum("e") / sum("d"))).toFixed(1)} dB`,
        `control power ${(sum("y") / sum("samples") / rated).toFixed(2)} of the rating`,
        ...(chosen() === "KF-OPC" ? [`constraint factor ${factor.toFixed(2)}`] : []),
        ...(status ? ["switched off: its numbers grew beyond all limits"] : []),
      ];
      said(`In the last second: ${parts.join(", ")}.`);
    }
    requestAnimationFrame(draw);
  }

  // The visitor's own files.

  async function own() {
    try {
      const files = {};
      for (const name of ["noise", "primary", "secondary"]) {
        const [file] = at(name).files;
        if (file) files[name] = readWav(await file.arrayBuffer(), file.name);
      }
      const duct = builtIn(), fs = (files.noise ?? files.primary ?? files.secondary ?? duct).fs;
      for (const [name, file] of Object.entries(files))
        if (file.fs !== fs) throw new Error(`The ${name} file is sampled at ${file.fs} Hz, another one at ${fs} Hz: resample it.`);
      if (!files.noise && fs !== duct.fs) throw new Error(`Give a noise sampled at ${fs} Hz too: the built-in one is sampled at ${duct.fs} Hz.`);
      for (const name of ["primary", "secondary"])
        if (files[name]?.samples.length > 2048) throw new Error(`The ${name} path has more than 2048 samples: cut off its end.`);
      const taken = (name) => files[name]?.samples ?? duct[name];
      signals = prepared({ fs, noise: taken("noise"), primary: taken("primary"), secondary: taken("secondary") });
      history = [];
      if (playing) await stop();
      said("Your files are ready: press Play.");
    } catch (error) {
      said(error.message);
    }
  }

  at("play").onclick = () => (playing ? stop() : play().catch((error) => said(`No sound: ${error.message}`)));
  at("level").oninput = () => {
    showLevel();
    if (!playing) return;
    playing.rated = scene().rated;
    playing.loop.port.postMessage({ rated: playing.rated });
  };
  place.querySelectorAll("input[type=radio]").forEach((radio) => { radio.onchange = () => change(); });
  place.querySelectorAll("input[type=file]").forEach((input) => { input.onchange = own; });
  showLevel();
})();
