"use strict";
// All tracks of a player run at once and one of them is heard, so that a switch keeps the moment. Without this script the
// page has the browser's own players instead.
(() => {
  const FADE_S = 0.005; // a switch without a click
  let context = null;
  let running = null;

  const bytes = (source) =>
    Uint8Array.from(atob(source.slice(source.indexOf(",") + 1)), (letter) => letter.charCodeAt(0)).buffer;

  class Player {
    constructor(box) {
      this.box = box;
      this.audio = [...box.querySelectorAll("audio")];
      this.play = box.querySelector(".play");
      this.control = box.querySelector(".control");
      this.radios = [...box.querySelectorAll("input[type=radio]")];
      this.progress = box.querySelector("progress");
      this.status = box.querySelector("[role=status]");
      this.chosen = Number(this.radios.find((radio) => radio.checked).value);
      this.on = false;
      this.play.addEventListener("click", () => (this.sources ? this.stop() : this.start()));
      this.control.addEventListener("click", () => this.hear(!this.on, this.chosen));
      for (const radio of this.radios) radio.addEventListener("change", () => this.hear(true, Number(radio.value)));
      box.classList.add("ready");
      box.querySelector(".switch").hidden = false;
      this.hear(false, this.chosen);
    }

    get heard() {
      return this.on ? this.chosen : 0;
    }

    hear(on, chosen) {
      this.on = on;
      this.chosen = chosen;
      this.control.textContent = on ? "Control is on" : "Control is off";
      this.status.textContent = `You hear: ${this.audio[this.heard].getAttribute("aria-label")}`;
      this.box.dataset.heard = this.heard;
      (this.gains || []).forEach((gain, i) =>
        gain.gain.setTargetAtTime(i === this.heard ? 1 : 0, context.currentTime, FADE_S));
    }

    async start() {
      if (this.starting) return;
      this.starting = true; // the button stays enabled, for a disabled one loses the focus
      try {
        context ??= new AudioContext();
        await context.resume();
        this.buffers ??= await Promise.all(this.audio.map((track) => context.decodeAudioData(bytes(track.src))));
      } catch (error) { // a browser that cannot decode them: its own players may
        this.box.classList.remove("ready");
        this.box.querySelector(".switch").hidden = true;
        throw error;
      } finally {
        this.starting = false;
      }
      if (running) running.stop();
      this.gains = this.buffers.map((_, i) => new GainNode(context, { gain: i === this.heard ? 1 : 0 }));
      this.sources = this.buffers.map((buffer, i) => {
        const source = new AudioBufferSourceNode(context, { buffer, loop: true });
        source.connect(this.gains[i]).connect(context.destination);
        return source;
      });
      this.began = context.currentTime + 0.05;
      for (const source of this.sources) source.start(this.began);
      running = this;
      this.play.textContent = "■ Stop";
      this.show();
    }

    stop() {
      cancelAnimationFrame(this.frame);
      for (const source of this.sources) source.stop();
      for (const gain of this.gains) gain.disconnect();
      this.sources = this.gains = running = null;
      this.progress.value = 0;
      this.play.textContent = "▶ Play";
    }

    show() {
      const duration = this.buffers[0].duration;
      this.progress.value = (Math.max(0, context.currentTime - this.began) % duration) / duration;
      this.frame = requestAnimationFrame(() => this.show());
    }
  }

  for (const box of document.querySelectorAll(".player.group")) box.player = new Player(box);
})();
