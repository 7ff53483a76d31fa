"use strict";
// Before-and-after viewers, and curves that can be zoomed. Everything they show is in the page.

function viewer(box) {
  const stage = box.querySelector(".stage");
  const split = box.querySelector(".split"), slice = box.querySelector(".slice");
  const show = () => {
    stage.style.setProperty("--split", split.value + "%");
  };
  split.addEventListener("input", show);
  const drag = event => {
    if (event.buttons || event.type === "pointerdown") {
      const frame = stage.getBoundingClientRect();
      const part = (event.clientX - frame.left) / frame.width;
      split.value = Math.round(100 * Math.min(1, Math.max(0, part)));
      show();
    }
  };
  stage.addEventListener("pointerdown", drag);
  stage.addEventListener("pointermove", drag);
  show();
  if (!slice) return;
  const slices = JSON.parse(box.querySelector("script").textContent);
  const place = box.querySelector("output");
  const choose = () => {
    const one = slices[Number(slice.value)];
    stage.querySelector(".before").src = one.before;
    stage.querySelector(".after").src = one.after;
    place.textContent = one.place;
  };
  slice.addEventListener("input", choose);
  choose();
}

function ticks(low, high, most) {
  const raw = (high - low) / most, decade = 10 ** Math.floor(Math.log10(raw));
  const step = decade * [1, 2, 5, 10].find(s => s * decade >= raw * 0.999);
  const found = [];
  for (let k = Math.ceil(low / step); k * step <= high + 1e-9 * step; ++k) found.push(k * step);
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  return found.map(value => [value, value.toFixed(Math.min(digits, 8))]);
}

function extent(values) {
  let low = Infinity, high = -Infinity;
  for (const value of values) {
    if (value === null) continue;
    if (value < low) low = value;
    if (value > high) high = value;
  }
  if (low > high) return [0, 1];
  const margin = 0.06 * (high - low) || Math.max(1e-6, 0.01 * Math.abs(high));
  return [low - margin, high + margin];
}

function chart(box) {
  const data = JSON.parse(box.querySelector("script").textContent);
  const canvas = box.querySelector("canvas"), output = box.querySelector("output");
  const buttons = [...box.querySelectorAll("button[data-axis]")];
  let axis = "view", range = null, start = null, end = null;
  const left = 62, bottom = 34, top = 8, right = 10;

  const xs = () => data.axes[axis].values;
  const bounds = () => range || extent(xs());
  function frame() {
    const wide = canvas.clientWidth, high = canvas.clientHeight;
    const [x0, x1] = bounds();
    const inside = [];
    for (const one of data.series)
      one.values.forEach((y, k) => {
        if (xs()[k] >= x0 && xs()[k] <= x1) inside.push(y);
      });
    const [y0, y1] = data.limits && !range ? data.limits : extent(inside);
    return {
      wide, high, x0, x1, y0, y1,
      x: v => left + (v - x0) / (x1 - x0) * (wide - left - right),
      y: v => high - bottom - (v - y0) / (y1 - y0) * (high - bottom - top),
      at: p => x0 + (p - left) / (wide - left - right) * (x1 - x0),
    };
  }
  function draw() {
    const ratio = window.devicePixelRatio || 1, f = frame();
    canvas.width = Math.round(f.wide * ratio);
    canvas.height = Math.round(f.high * ratio);
    const g = canvas.getContext("2d");
    g.scale(ratio, ratio);
    g.font = "12px system-ui, sans-serif";
    g.fillStyle = "#5b6875";
    g.strokeStyle = "#e6eaee";
    g.textAlign = "center";
    for (const [value, text] of ticks(f.x0, f.x1, Math.max(2, f.wide / 110))) {
      g.beginPath(); g.moveTo(f.x(value), top); g.lineTo(f.x(value), f.high - bottom); g.stroke();
      g.fillText(text, f.x(value), f.high - bottom + 15);
    }
    g.textAlign = "right";
    for (const [value, text] of ticks(f.y0, f.y1, 5)) {
      g.beginPath(); g.moveTo(left, f.y(value)); g.lineTo(f.wide - right, f.y(value)); g.stroke();
      g.fillText(text, left - 6, f.y(value) + 4);
    }
    g.textAlign = "center";
    g.fillText(data.axes[axis].label, (left + f.wide - right) / 2, f.high - 3);
    g.save();
    g.translate(12, (top + f.high - bottom) / 2);
    g.rotate(-Math.PI / 2);
    g.fillText(data.label, 0, 0);
    g.restore();
    g.save();
    g.beginPath(); g.rect(left, top, f.wide - left - right, f.high - top - bottom); g.clip();
    if (data.band) {
      g.fillStyle = "rgba(0, 114, 178, .08)";
      g.fillRect(left, f.y(data.band[1]), f.wide, f.y(data.band[0]) - f.y(data.band[1]));
    }
    const size = xs().length > 1500 ? 1.1 : xs().length > 400 ? 1.7 : 2.4;
    for (const one of data.series) {
      g.fillStyle = g.strokeStyle = one.colour;
      one.values.forEach((value, k) => {
        if (value === null) return;
        const x = f.x(xs()[k]), y = f.y(value);
        g.beginPath();
        if (one.cross) {
          g.lineWidth = 1.6;
          g.moveTo(x - 4, y - 4); g.lineTo(x + 4, y + 4);
          g.moveTo(x - 4, y + 4); g.lineTo(x + 4, y - 4);
          g.stroke();
        } else {
          g.arc(x, y, size, 0, 7);
          g.fill();
        }
      });
    }
    if (start !== null && end !== null) {
      g.fillStyle = "rgba(255, 210, 74, .3)";
      g.fillRect(Math.min(start, end), top, Math.abs(end - start), f.high);
    }
    g.restore();
  }
  function read(place) {
    const f = frame(), wanted = f.at(place);
    let nearest = 0;
    xs().forEach((value, k) => {
      if (Math.abs(value - wanted) < Math.abs(xs()[nearest] - wanted)) nearest = k;
    });
    const values = data.series.filter(one => one.values[nearest] !== null)
      .map(one => `${one.name} ${one.values[nearest].toPrecision(4)}`);
    output.textContent = `view ${nearest}: ${values.join(", ")}`;
  }
  const place = event => event.clientX - canvas.getBoundingClientRect().left;
  canvas.addEventListener("pointerdown", event => { start = place(event); end = null; });
  canvas.addEventListener("pointermove", event => {
    read(place(event));
    if (start !== null && event.buttons) { end = place(event); draw(); }
  });
  const finish = () => {
    if (start !== null && end !== null && Math.abs(end - start) > 8) {
      const f = frame();
      range = [f.at(Math.min(start, end)), f.at(Math.max(start, end))];
    }
    start = end = null;
    draw();
  };
  canvas.addEventListener("pointerup", finish);
  canvas.addEventListener("pointerleave", finish);
  const reset = () => { range = null; draw(); };
  canvas.addEventListener("dblclick", reset);
  box.querySelector("button.reset").addEventListener("click", reset);
  for (const button of buttons)
    button.addEventListener("click", () => {
      axis = button.dataset.axis;
      for (const one of buttons) one.setAttribute("aria-pressed", String(one === button));
      reset();
    });
  new ResizeObserver(draw).observe(canvas);
  draw();
}

document.querySelectorAll(".viewer").forEach(viewer);
document.querySelectorAll(".chart").forEach(chart);
