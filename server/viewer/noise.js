// Masking noise: plays while a prompt requests it by `data-masking-noise`, once the participant has clicked or pressed a
// key, which browsers demand. Made here, so that no file is loaded.
const NOISE_S = 10;
const NOISE_EVERY_MS = 50;
const NOISE_FADE_S = 0.05;
const OCTAVES = 12;
let audio = null;

// Pink: a sum of random numbers of which number k is drawn anew every 2^k samples (Voss and McCartney).
function samples(kind, count) {
  const rows = new Float32Array(OCTAVES), values = new Float32Array(count);
  for (let index = 0; index < count; index++) {
    if (kind === "white") {
      values[index] = 2 * Math.random() - 1;
      continue;
    }
    rows[Math.min(31 - Math.clz32((index + 1) & -(index + 1)), OCTAVES - 1)] = (2 * Math.random() - 1) / Math.sqrt(OCTAVES);
    values[index] = rows.reduce((sum, row) => sum + row, 0);
  }
  return values;
}

function play(kind) {
  if (audio.kind === kind) return;
  audio.source?.stop();
  audio.kind = kind;
  audio.source = audio.context.createBufferSource();
  const rate = audio.context.sampleRate, buffer = audio.context.createBuffer(1, NOISE_S * rate, rate);
  buffer.copyToChannel(samples(kind, buffer.length), 0);
  audio.source.buffer = buffer;
  audio.source.loop = true;
  audio.source.connect(audio.gain);
  audio.source.start();
}

function follow() {
  if (!audio) return;
  const request = page.document.querySelector("[data-masking-noise]");
  if (request) play(request.dataset.maskingNoise);
  const volume = request ? Number(request.dataset.volume) : 0;
  audio.gain.gain.setTargetAtTime(volume, audio.context.currentTime, NOISE_FADE_S);
  page.document.body.dataset.noise = `${audio.context.state} ${volume}`;
}

for (const gesture of ["pointerdown", "keydown"]) {
  page.document.addEventListener(gesture, () => {
    if (!audio) {
      const context = new page.AudioContext(), gain = context.createGain();
      gain.gain.value = 0;
      gain.connect(context.destination);
      audio = { context, gain, source: null, kind: "" };
    }
    audio.context.resume();
  }, true);
}
setInterval(follow, NOISE_EVERY_MS);
