// Metrics over frames, one line per method; filled dots are rendered frames, hollow squares extrapolated ones.

const curves = {
  hidden: new Set(),
  size: { width: 1100, height: 360, left: 56, right: 12, top: 14, bottom: 36 },

  /** [{method, color, points: [{frame, kind, value}]}] for what the selects say. */
  lines() {
    const [sequence, metric, frames, resolution] = ["sequence", "metric", "kind", "resolution"].map((id) => pick(`curve-${id}`).value);
    const column = DATA.columns.find((c) => c.key === metric);
    const result = [];
    Object.entries(DATA.curves).forEach(([method, bySequence], k) => {
      const rows = (bySequence[sequence] || []).filter((row) => row.resolution === resolution);
      const wanted = (row) => {
        if (frames === "ss" || frames === "ess") return row.kind === frames;
        return row.kind === (row.frame % 2 === (frames === "even" ? 0 : 1) ? "ss" : "ess");
      };
      const shown = rows.filter(wanted);
      // A method that renders every frame has no extrapolated ones: show it as it is displayed.
      const chosen = shown.length && !rows.some((row) => row.kind === "ess") && frames !== "ess" ? rows : shown;
      const points = chosen.filter((row) => row[metric] !== null && row[metric] !== undefined)
        .map((row) => ({ frame: row.frame, kind: row.kind, value: this.value(row, column) }))
        .sort((a, b) => a.frame - b.frame);
      if (points.length) result.push({ method, color: `var(--c${k % 12})`, points });
    });
    return result;
  },

  value(row, column) {
    const own = column.key === "warped_error" ? row.warped_error_reference || 0 : 0;
    return (row[column.key] - own) * column.scale;
  },

  draw() {
    const all = this.lines();
    const visible = all.filter((line) => !this.hidden.has(line.method));
    this.legend(all);
    const { width, height, left, right, top, bottom } = this.size;
    const svg = pick("plot");
    svg.setAttribute("viewBox", `0 0 ${width} ${height}`);
    const values = visible.flatMap((line) => line.points.map((p) => p.value));
    if (!values.length) {
      svg.innerHTML = `<text x="${width / 2}" y="${height / 2}" text-anchor="middle">nothing was scored here</text>`;
      this.scale = null;
      return;
    }
    const frames = [...new Set(visible.flatMap((line) => line.points.map((p) => p.frame)))].sort((a, b) => a - b);
    const [low, high, step] = niceRange(Math.min(...values), Math.max(...values));
    const [first, last] = [frames[0] - 0.5, frames[frames.length - 1] + 0.5];
    const x = (frame) => left + ((frame - first) / (last - first)) * (width - left - right);
    const y = (value) => top + ((high - value) / (high - low)) * (height - top - bottom);
    const parts = [];
    for (const frame of frames) {
      const kinds = new Set(visible.flatMap((line) => line.points.filter((p) => p.frame === frame).map((p) => p.kind)));
      if (kinds.has("ess")) {
        parts.push(`<rect class="band" x="${x(frame - 0.5)}" y="${top}" width="${x(frame + 0.5) - x(frame - 0.5)}" height="${height - top - bottom}"/>`);
      }
      const every = Math.ceil(frames.length / 24);
      if ((frame - frames[0]) % every === 0) parts.push(`<text x="${x(frame)}" y="${height - bottom + 18}" text-anchor="middle">${frame}</text>`);
    }
    for (let value = low; value <= high + step / 1e3; value += step) {
      parts.push(`<line class="grid" x1="${left}" x2="${width - right}" y1="${y(value)}" y2="${y(value)}"/>`);
      parts.push(`<text x="${left - 8}" y="${y(value) + 4}" text-anchor="end">${Number(value.toPrecision(6))}</text>`);
    }
    parts.push(`<text x="${(left + width - right) / 2}" y="${height - 3}" text-anchor="middle">frame</text>`);
    for (const line of visible) {
      const kind = line.method === DATA.variant ? ' class="variant"' : "";
      const path = line.points.map((p, k) => `${k ? "L" : "M"}${x(p.frame).toFixed(1)} ${y(p.value).toFixed(1)}`).join("");
      const dash = DATA.references.includes(line.method) ? ' stroke-dasharray="5 4"' : "";
      parts.push(`<path${kind} d="${path}" stroke="${line.color}"${dash}/>`);
      for (const p of line.points) parts.push(marker(x(p.frame), y(p.value), p.kind, line.color));
    }
    svg.innerHTML = parts.join("");
    this.scale = { x, frames, visible };
  },

  legend(lines) {
    pick("legend").replaceChildren(...lines.map((line) => {
      const button = document.createElement("button");
      const swatch = document.createElement("i");
      swatch.style.background = line.color;
      button.type = "button";
      button.setAttribute("aria-pressed", String(!this.hidden.has(line.method)));
      button.append(swatch, line.method);
      button.addEventListener("click", () => {
        if (!this.hidden.delete(line.method)) this.hidden.add(line.method);
        this.draw();
      });
      return button;
    }), Object.assign(document.createElement("span"), { textContent: "● rendered   □ extrapolated (shaded)   - - for orientation" }));
  },

  hover(event) {
    const tip = pick("tip");
    tip.hidden = !this.scale || event.type === "pointerleave";
    if (tip.hidden) return;
    const box = pick("plot").getBoundingClientRect();
    const at = ((event.clientX - box.left) / box.width) * this.size.width;
    const distance = (frame) => Math.abs(this.scale.x(frame) - at);
    const frame = this.scale.frames.reduce((a, b) => (distance(b) < distance(a) ? b : a));
    const column = DATA.columns.find((c) => c.key === pick("curve-metric").value);
    const found = this.scale.visible
      .flatMap((line) => line.points.filter((p) => p.frame === frame).map((p) => ({ ...p, ...line })))
      .sort((a, b) => b.value - a.value);
    const head = document.createElement("b");
    head.textContent = `frame ${frame}`;
    tip.replaceChildren(head, ...found.map((item) => {
      const row = document.createElement("div");
      const name = document.createElement("span");
      const swatch = document.createElement("i");
      swatch.style.background = item.color;
      name.append(swatch, `${item.method} (${item.kind})`);
      row.append(name, item.value.toFixed(column.digits));
      return row;
    }));
    const px = (this.scale.x(frame) / this.size.width) * box.width;
    tip.style.left = px > box.width / 2 ? "" : `${px + 14}px`;
    tip.style.right = px > box.width / 2 ? `${box.width - px + 14}px` : "";
    tip.style.top = "10px";
  },
};

function marker(x, y, kind, color) {
  return kind === "ess"
    ? `<rect x="${x - 3.5}" y="${y - 3.5}" width="7" height="7" fill="var(--card)" stroke="${color}" stroke-width="2"/>`
    : `<circle cx="${x}" cy="${y}" r="3.6" fill="${color}"/>`;
}

/** [low, high, step] around the data with round numbers. */
function niceRange(low, high) {
  const span = high - low || Math.abs(high) || 1;
  const rough = span / 5;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].find((s) => s * power >= rough) * power;
  return [Math.floor(low / step) * step, Math.ceil(high / step) * step + (low === high ? step : 0), step];
}

function startCurves() {
  const all = Object.values(DATA.curves);
  const names = [...new Set(all.flatMap((bySequence) => Object.keys(bySequence)))];
  if (!names.length) return;
  pick("curves").hidden = false;
  const rows = all.flatMap((bySequence) => Object.values(bySequence).flat());
  const found = (key) => [...new Set(rows.map((row) => row[key]))].sort();
  const metrics = DATA.columns.filter((c) => rows.some((row) => row[c.key] !== null && row[c.key] !== undefined));
  fillSelect(pick("curve-sequence"), names.map((name) => [name, name]), names[0]);
  fillSelect(pick("curve-metric"), metrics.map((c) => [c.key, c.label]), "psnr");
  fillSelect(pick("curve-resolution"), found("resolution").map((r) => [r, r.toUpperCase()]), found("resolution")[0]);
  for (const id of ["sequence", "metric", "kind", "resolution"]) pick(`curve-${id}`).addEventListener("change", () => curves.draw());
  for (const type of ["pointermove", "pointerleave"]) pick("plot").addEventListener(type, (event) => curves.hover(event));
  curves.draw();
}
