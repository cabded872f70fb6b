// The picture viewer: a draggable split between two methods, and the same magnified spot in all of them.

const pick = (id) => document.getElementById(id);
const clamp = (value, low, high) => Math.min(Math.max(value, low), high);

function makeCanvas(width, height) {
  const canvas = document.createElement("canvas");
  canvas.width = width;
  canvas.height = height;
  return canvas;
}

/** Decode a data URI: {canvas, width, height, data: RGBA bytes}. */
async function loadPixels(uri) {
  const image = new Image();
  image.src = uri;
  await image.decode();
  const canvas = makeCanvas(image.naturalWidth, image.naturalHeight);
  const context = canvas.getContext("2d", { willReadFrequently: true });
  context.drawImage(image, 0, 0);
  const { width, height } = canvas;
  return { canvas, width, height, data: context.getImageData(0, 0, width, height).data };
}

/** A map in colours: value(x, y) in [0, 1], times gain, through the look-up table. */
function colorMap(width, height, gain, value) {
  const canvas = makeCanvas(width, height);
  const context = canvas.getContext("2d");
  const out = context.createImageData(width, height);
  for (let y = 0, k = 0; y < height; y++) {
    for (let x = 0; x < width; x++, k += 4) {
      const color = DATA.colormap[Math.round(255 * clamp(gain * value(x, y), 0, 1))];
      out.data[k] = color[0];
      out.data[k + 1] = color[1];
      out.data[k + 2] = color[2];
      out.data[k + 3] = 255;
    }
  }
  context.putImageData(out, 0, 0);
  return canvas;
}

/** Offset into RGBA bytes of the pixel of `image` nearest to (x, y) of a width x height picture. */
function nearest(image, x, y, width, height) {
  const column = Math.floor(((x + 0.5) * image.width) / width);
  const row = Math.floor(((y + 0.5) * image.height) / height);
  return 4 * (row * image.width + column);
}

const viewer = {
  picture: null, images: new Map(), views: new Map(), crops: new Map(),
  left: "", right: "", mode: "image", gain: 4, split: 0.5, focus: [0, 0], pinned: false,

  async open(index) {
    const picture = DATA.pictures[index];
    const loaded = await Promise.all(picture.images.map(async (image) => ({
      name: image.name, psnr: image.psnr, pixels: await loadPixels(image.src),
      flicker: image.flicker ? await loadPixels(image.flicker) : null,
    })));
    this.picture = picture;
    this.images = new Map(loaded.map((image) => [image.name, image]));
    this.views.clear();
    this.pinned = false;
    this.focus = [picture.focus[0], picture.focus[1]];
    const names = [...this.images.keys()];
    const methods = names.filter((name) => name !== "reference" && name !== "input");
    if (!names.includes(this.left)) this.left = names.includes("input") ? "input" : methods[0] || names[0];
    if (!names.includes(this.right)) this.right = methods.includes(DATA.variant) ? DATA.variant : names[names.length - 1];
    for (const side of ["left", "right"]) fillSelect(pick(side), names.map((name) => [name, name]), this[side]);
    const hasFlicker = loaded.some((image) => image.flicker);
    document.querySelector('[data-mode="flicker"]').disabled = !hasFlicker;
    if (this.mode === "flicker" && !hasFlicker) this.mode = "image";
    this.buildCrops(names);
    this.draw();
  },

  /** What the chosen mode shows of a method, as a canvas; null where the mode has nothing to show. */
  view(name) {
    const key = `${name}/${this.mode}/${this.gain}`;
    if (!this.views.has(key)) this.views.set(key, this.render(this.images.get(name)));
    return this.views.get(key);
  },

  render(image) {
    const { width, height } = this.picture;
    if (this.mode === "image") return image.pixels.canvas;
    if (this.mode === "flicker") {
      if (!image.flicker) return null;
      const flicker = image.flicker;
      const gain = this.gain / DATA.flickerGain;
      return colorMap(width, height, gain, (x, y) => flicker.data[nearest(flicker, x, y, width, height)] / 255);
    }
    if (image.name === "reference") return null;
    const [a, b] = [image.pixels, this.images.get("reference").pixels];
    return colorMap(width, height, this.gain, (x, y) => {
      const i = nearest(a, x, y, width, height);
      const k = nearest(b, x, y, width, height);
      const sum = Math.abs(a.data[i] - b.data[k]) + Math.abs(a.data[i + 1] - b.data[k + 1]) + Math.abs(a.data[i + 2] - b.data[k + 2]);
      return sum / 765;
    });
  },

  buildCrops(names) {
    const grid = pick("crops");
    grid.replaceChildren();
    this.crops.clear();
    for (const name of names) {
      const figure = document.createElement("figure");
      const canvas = makeCanvas(this.picture.crop[0] * 8, this.picture.crop[1] * 8);
      const caption = document.createElement("figcaption");
      const title = document.createElement("b");
      const score = document.createElement("span");
      const psnr = this.images.get(name).psnr;
      title.textContent = name;
      score.textContent = psnr === null ? "" : `${psnr.toFixed(2)} dB`;
      caption.append(title, score);
      figure.append(canvas, caption);
      figure.title = "Click: show on the right. Shift-click: on the left.";
      figure.addEventListener("click", (event) => this.choose(event.shiftKey ? "left" : "right", name));
      grid.append(figure);
      this.crops.set(name, { figure, canvas });
    }
  },

  choose(side, name) {
    this[side] = name;
    pick(side).value = name;
    this.draw();
  },

  draw() {
    const { width, height } = this.picture;
    const canvas = pick("canvas");
    const scale = Math.max(1, Math.round(1200 / width));
    canvas.width = width * scale;
    canvas.height = height * scale;
    pick("stage").style.maxWidth = `calc(82vh * ${width / height})`; // the whole picture fits on a screen
    pick("gain-label").hidden = this.mode === "image";
    pick("gain").value = this.gain;
    pick("gain-value").textContent = `×${this.gain}`;
    for (const button of pick("mode").children) button.setAttribute("aria-checked", String(button.dataset.mode === this.mode));
    for (const side of ["left", "right"]) {
      const psnr = this.images.get(this[side]).psnr;
      const small = document.createElement("small");
      small.textContent = psnr === null ? "" : `${psnr.toFixed(2)} dB`;
      pick(`tag-${side}`).replaceChildren(this[side], small);
    }
    this.drawSplit();
    this.drawCrops();
  },

  drawSplit() {
    const canvas = pick("canvas");
    const context = canvas.getContext("2d");
    context.imageSmoothingEnabled = false;
    context.fillStyle = "#111";
    context.fillRect(0, 0, canvas.width, canvas.height);
    const edge = Math.round(this.split * canvas.width);
    for (const [name, from, to] of [[this.left, 0, edge], [this.right, edge, canvas.width]]) {
      const view = this.view(name);
      if (!view || to <= from) continue;
      context.save();
      context.beginPath();
      context.rect(from, 0, to - from, canvas.height);
      context.clip();
      context.drawImage(view, 0, 0, canvas.width, canvas.height);
      context.restore();
    }
    pick("split").style.left = `${100 * this.split}%`;
    pick("stage").setAttribute("aria-valuenow", String(Math.round(100 * this.split)));
  },

  drawCrops() {
    const { width, height, crop } = this.picture;
    const [x, y] = this.focus;
    for (const [name, { figure, canvas }] of this.crops) {
      const context = canvas.getContext("2d");
      context.imageSmoothingEnabled = false;
      context.clearRect(0, 0, canvas.width, canvas.height);
      const view = this.view(name);
      figure.hidden = !view;
      if (view) {
        const [sx, sy] = [view.width / width, view.height / height];
        context.drawImage(view, x * sx, y * sy, crop[0] * sx, crop[1] * sy, 0, 0, canvas.width, canvas.height);
      }
      const side = name === this.left ? " left" : name === this.right ? " right" : "";
      figure.className = `crop${side}${name === DATA.variant ? " variant" : ""}`;
    }
    const box = pick("focus");
    box.className = this.pinned ? "focus pinned" : "focus";
    Object.assign(box.style, {
      left: `${(100 * x) / width}%`, top: `${(100 * y) / height}%`,
      width: `${(100 * crop[0]) / width}%`, height: `${(100 * crop[1]) / height}%`,
    });
    const where = `${crop[0]}×${crop[1]} pixels at (${x}, ${y})`;
    pick("hint").textContent = this.pinned
      ? `Pinned: ${where}. Click the picture to release.`
      : `Magnified below: ${where}. It opens where the methods disagree most. Arrow keys move the split.`;
  },

  moveSplit(share) {
    this.split = clamp(share, 0, 1);
    this.drawSplit();
  },

  moveFocus(shareX, shareY) {
    const { width, height, crop } = this.picture;
    this.focus = [
      Math.round(clamp(shareX * width - crop[0] / 2, 0, width - crop[0])),
      Math.round(clamp(shareY * height - crop[1] / 2, 0, height - crop[1])),
    ];
    this.drawCrops();
  },
};

function fillSelect(select, options, value) {
  select.replaceChildren(...options.map(([key, text]) => new Option(text, key, false, key === value)));
}

function startViewer() {
  if (!DATA.pictures.length) return;
  pick("pictures").hidden = false;
  const label = (p) => `${p.sequence} · frame ${p.frame} · ${DATA.kinds[p.kind] || p.kind} · ${p.resolution.toUpperCase()}`;
  fillSelect(pick("picture"), DATA.pictures.map((p, k) => [String(k), label(p)]), "0");
  viewer.gain = DATA.errorGain;
  pick("picture").addEventListener("change", (event) => viewer.open(Number(event.target.value)));
  for (const side of ["left", "right"]) {
    pick(side).addEventListener("change", (event) => viewer.choose(side, event.target.value));
  }
  pick("mode").addEventListener("click", (event) => {
    const mode = event.target.dataset.mode;
    if (!mode) return;
    viewer.mode = mode;
    viewer.draw();
  });
  pick("gain").addEventListener("input", (event) => {
    viewer.gain = Number(event.target.value);
    viewer.views.clear();
    viewer.draw();
  });
  const stage = pick("stage");
  const share = (event) => {
    const box = stage.getBoundingClientRect();
    return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  };
  let drag = null; // where the pointer went down, and whether it has moved far enough to be a drag
  stage.addEventListener("pointerdown", (event) => {
    drag = { x: event.clientX, moved: event.target.closest("#split") !== null, onHandle: event.target.closest("#split") !== null };
    try { stage.setPointerCapture(event.pointerId); } catch { /* a synthetic pointer cannot be captured */ }
  });
  stage.addEventListener("pointermove", (event) => {
    const [x, y] = share(event);
    if (drag && Math.abs(event.clientX - drag.x) > 3) drag.moved = true;
    if (drag && drag.moved) viewer.moveSplit(x);
    else if (!drag && !viewer.pinned && event.target.closest("#split") === null) viewer.moveFocus(x, y);
  });
  stage.addEventListener("pointerup", (event) => {
    if (drag && !drag.moved) {
      viewer.pinned = !viewer.pinned;
      viewer.moveFocus(...share(event));
    }
    drag = null;
  });
  stage.addEventListener("pointercancel", () => { drag = null; });
  stage.addEventListener("keydown", (event) => {
    const step = { ArrowLeft: -0.02, ArrowRight: 0.02 }[event.key];
    if (!step) return;
    event.preventDefault();
    viewer.moveSplit(viewer.split + step);
  });
  return viewer.open(0);
}
