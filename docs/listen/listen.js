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
    <style>
      #listen { --ink: var(--color-foreground-primary, CanvasText); --page: var(--color-background-primary, Canvas);
        --line: var(--color-background-border, GrayText); --brand: var(--color-brand-content, #0a58a8); margin: 1rem 0 1.5rem; }
      #listen svg, #listen canvas { display: block; width: 100%; color: var(--ink); }
      #listen svg { max-width: 34rem; margin: 0 auto; font: 13px sans-serif; }
      #listen canvas { height: 22rem; }
      #listen canvas[hidden] { display: none; }
      #listen button { display: block; margin: 0.75rem auto; min-width: 12rem; padding: 0.7rem 2rem; font: 600 1.25rem sans-serif;
        color: var(--page); background: var(--brand); border: 0; border-radius: 2rem; cursor: pointer; }
      #listen-controls { display: flex; flex-wrap: wrap; justify-content: center; align-items: center; gap: 0.4rem; font-size: 0.9rem; }
      #listen-controls label { display: inline-flex; align-items: center; gap: 0.3rem; min-height: 2.25rem; white-space: nowrap; }
      #listen-controls label:has([type="radio"]) { padding: 0 0.6rem; border: 1px solid var(--line); border-radius: 2rem; cursor: pointer; }
      #listen-controls label:has(:checked) { border-color: var(--brand); box-shadow: inset 0 0 0 1px var(--brand); }
      #listen input { accent-color: var(--brand); margin: 0; }
      #listen-level { width: 5rem; }
      #listen-level-db { min-width: 3rem; }
      #listen-said { min-height: 1.6em; margin: 0.75rem 0; text-align: center; font-weight: 600; }
      #listen-said:empty { display: none; }
      #listen details { margin-top: 1rem; }
    </style>
    <svg viewBox="0 0 380 136" role="img" aria-label="A duct: noise, a microphone, a loudspeaker, and the place where you listen">
      <g fill="none" stroke="currentColor" stroke-width="2">
        <path d="M10 22H372M10 78H272M320 78H372M100 50V108H118M190 108H206M232 108H296V92"/>
        <path d="M118 96H190V120H118ZM206 96V120L232 108ZM282 92H310L320 78H272Z" fill="var(--page)"/>
      </g>
      <path id="listen-wave" fill="none" stroke="#d55e00" stroke-width="2.5"/>
      <g fill="currentColor"><circle cx="100" cy="50" r="6"/><circle cx="356" cy="50" r="6"/><text x="10" y="14">noise</text>
        <text x="100" y="14" text-anchor="middle">microphone</text><text x="372" y="14" text-anchor="end">you listen here</text>
        <text x="154" y="112" text-anchor="middle">controller</text><text x="219" y="133" text-anchor="middle">amplifier</text>
        <text x="296" y="133" text-anchor="middle">loudspeaker</text></g>
    </svg>
    <button id="listen-play">▶ Play</button>
    <div id="listen-controls">
      ${Object.keys(LISTEN.controllers).map((name) => `<label><input type="radio" name="listen-controller" value="${name}">${name}</label>`).join("")}
      <label>too loud by <input type="range" id="listen-level" min="${LEAST_DB}" max="${MOST_DB}" step="0.5" value="6">
        <output id="listen-level-db"></output></label></div>
    <p id="listen-said" role="status"></p>
    <canvas id="listen-figure" hidden></canvas>
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
    at("play").textContent = "■ Stop";
    at("figure").hidden = false;
    requestAnimationFrame(draw);
  }

  async function stop() {
    const { context } = playing;
    playing = null;
    at("play").textContent = "▶ Play";
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

  const COLOURS = { before: "#999999", error: "#d55e00", power: "#2b87d1" };
  const [LEFT, TOP, GAP] = [52, 26, 56]; // of a plot, in pixels of the page
  const figure = at("figure").getContext("2d");

  // The canvas has as many pixels as the screen; return its size on the page.
  function cleared() {
    const canvas = at("figure"), scale = window.devicePixelRatio || 1;
    const [width, height] = [canvas.clientWidth, canvas.clientHeight];
    Object.assign(canvas, { width: Math.round(scale * width), height: Math.round(scale * height) });
    figure.scale(scale, scale);
    figure.font = "13px sans-serif";
    figure.fillStyle = getComputedStyle(canvas).color;
    return [width - LEFT - 8, (height - TOP - GAP - 22) / 2];
  }

  function axes(top, width, height, title, low, high, step, ticks) {
    const ink = figure.fillStyle, words = title.split("|");
    let x = LEFT;
    words.forEach((word) => {
      const [text, colour] = word.split("#");
      figure.fillStyle = COLOURS[colour] ?? ink;
      figure.fillText(text, x, top - 9);
      x += figure.measureText(text).width;
    });
    Object.assign(figure, { fillStyle: ink, strokeStyle: ink, lineWidth: 0.3 });
    const y = (value) => top + height * (1 - (Math.min(Math.max(value, low), high) - low) / (high - low));
    for (let value = low; value <= high; value += step) {
      figure.textAlign = "right";
      figure.fillText(`${value} dB`, LEFT - 6, y(value) + 4);
      curve([[LEFT, y(value)], [LEFT + width, y(value)]], ink, 0.3);
    }
    ticks.forEach((text, k) => {
      figure.textAlign = k === ticks.length - 1 ? "right" : k ? "center" : "left";
      figure.fillText(text, LEFT + (width * k) / (ticks.length - 1), top + height + 17);
    });
    figure.textAlign = "left";
    return y;
  }

  function curve(points, colour, width = 2) {
    figure.strokeStyle = colour;
    figure.lineWidth = width;
    figure.beginPath();
    points.forEach(([x, y], k) => (k ? figure.lineTo(x, y) : figure.moveTo(x, y)));
    figure.stroke();
  }

  // The sound in the drawing: behind the loudspeaker it has the amplitude that is left.
  function wave(left) {
    const t = performance.now() / 250;
    const points = Array.from({ length: 72 }, (_, k) => {
      const x = 14 + 5 * k, share = Math.min(Math.max((x - 270) / 60, 0), 1);
      return `${x} ${50 - 18 * (1 + share * (Math.min(left, 1.4) - 1)) * Math.sin(x / 9 - t)}`;
    });
    at("wave").setAttribute("d", `M${points.join("L")}`);
  }

  function draw() {
    if (!playing) return;
    const { error, disturbance, rated } = playing, [width, height] = cleared();
    const shown = Math.min(2000, signals.fs / 2);
    const spectra = [disturbance, error].map((analyser) => {
      const values = new Float32Array(analyser.frequencyBinCount);
      analyser.getFloatFrequencyData(values);
      return values.subarray(0, Math.floor((shown / (signals.fs / 2)) * values.length));
    });
    const peak = Math.max(-100, ...spectra[0]), steps = width < 420 ? [0, 2, 4] : [0, 1, 2, 3, 4];
    const level = axes(TOP, width, height, "At the microphone: |noise#before|, |what is left#error", -60, 0, 20, steps.map((k) => `${(shown * k) / 4} Hz`));
    spectra.forEach((values, k) =>
      curve(Array.from(values, (value, n) => [LEFT + (width * n) / values.length, level(value - peak)]), k ? COLOURS.error : COLOURS.before));
    const ratio = axes(TOP + height + GAP, width, height, "|power / rating#power|, |what is left / noise#error", -20, 40, 20, steps.map((k) => `${(SHOWN_S * k) / 4} s`));
    const x = (n) => LEFT + (width * n * (history[0]?.samples ?? 1)) / (SHOWN_S * signals.fs);
    const db = (value) => 10 * Math.log10(Math.max(value, 1e-6));
    curve([[LEFT, ratio(0)], [LEFT + width, ratio(0)]], figure.fillStyle, 1);
    curve(history.map(({ y, samples }, n) => [x(n), ratio(db(y / samples / rated))]), COLOURS.power);
    curve(history.map(({ e, d }, n) => [x(n), ratio(db(e / d))]), COLOURS.error);
    const recent = history.slice(-Math.ceil(signals.fs / (history[0]?.samples ?? 1)));
    if (recent.length) {
      const sum = (name) => recent.reduce((all, one) => all + one[name], 0), { status } = recent.at(-1);
      wave(Math.sqrt(sum("e") / sum("d")));
      const parts = [
        `Noise reduction ${(-db(sum("e") / sum("d"))).toFixed(1)} dB`,
        `power ${(sum("y") / sum("samples") / rated).toFixed(2)} of the rating`,
        ...(status ? ["switched off: its numbers grew beyond all limits"] : []),
      ];
      said(parts.join(", "));
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
  wave(1);
})();
