// SPDX-License-Identifier: Apache-2.0
'use strict';

// A strip chart on a canvas: the newest WINDOW seconds of some series, scaled to what is seen.
const WINDOW = 10; // s

class Strip {
  // series: [{colour (a CSS variable), width, pick(sample) -> number}]; least: smallest span of the y axis.
  constructor(canvas, series, { least, unit, bounds = null }) {
    Object.assign(this, { canvas, series, least, unit, bounds });
    this.range = null;
  }

  draw(samples) {
    const { canvas } = this;
    const scale = window.devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (canvas.width !== Math.round(width * scale)) canvas.width = Math.round(width * scale);
    if (canvas.height !== Math.round(height * scale)) canvas.height = Math.round(height * scale);
    const pen = canvas.getContext('2d');
    const style = getComputedStyle(canvas), css = name => style.getPropertyValue(name);
    pen.setTransform(scale, 0, 0, scale, 0, 0);
    pen.clearRect(0, 0, width, height);
    const left = 46, right = width - 6, top = 6, bottom = height - 18;
    const now = samples.length ? samples[samples.length - 1].t : 0;
    const [low, high] = this.limits(samples);
    const x = t => right - (now - t) / WINDOW * (right - left);
    const y = v => bottom - (v - low) / (high - low) * (bottom - top);
    this.grid(pen, { left, right, top, bottom, low, high, x, y, now, css });
    pen.save();
    pen.beginPath();
    pen.rect(left, top, right - left, bottom - top);
    pen.clip();
    pen.lineJoin = 'round';
    for (const { colour, width: line, pick, quiet } of this.series) {
      pen.globalAlpha = quiet ? 0.4 : 1;
      pen.strokeStyle = css(colour);
      pen.lineWidth = line;
      pen.beginPath();
      let open = false;
      for (const sample of samples) {
        const value = pick(sample);
        if (!Number.isFinite(value)) { open = false; continue; }
        if (open) pen.lineTo(x(sample.t), y(value)); else pen.moveTo(x(sample.t), y(value));
        open = true;
      }
      pen.stroke();
    }
    pen.restore();
  }

  limits(samples) {
    if (this.bounds) return this.bounds;
    let low = Infinity, high = -Infinity;
    // The accelerometer's angle is drawn faintly and as far as it fits: it must not squeeze the others.
    for (const { pick, quiet } of this.series) {
      if (quiet) continue;
      for (const sample of samples) {
        const value = pick(sample);
        if (Number.isFinite(value)) { low = Math.min(low, value); high = Math.max(high, value); }
      }
    }
    if (low > high) { low = 0; high = 0; }
    const middle = (low + high) / 2, half = Math.max((high - low) * 0.6, this.least / 2);
    const wanted = [middle - half, middle + half];
    // Grow at once, shrink slowly.
    this.range = this.range
      ? [Math.min(wanted[0], this.range[0] + 0.03 * (wanted[0] - this.range[0])),
         Math.max(wanted[1], this.range[1] + 0.03 * (wanted[1] - this.range[1]))]
      : wanted;
    return this.range;
  }

  grid(pen, { left, right, top, bottom, low, high, x, y, now, css }) {
    const rough = (high - low) / 6, power = 10 ** Math.floor(Math.log10(rough));
    const step = [1, 2, 5, 10].map(f => f * power).find(s => s >= rough);
    pen.font = '11px system-ui, sans-serif';
    pen.fillStyle = css('--quiet');
    pen.lineWidth = 1;
    pen.textAlign = 'right';
    pen.textBaseline = 'middle';
    for (let v = Math.ceil(low / step) * step; v <= high; v += step) {
      pen.strokeStyle = Math.abs(v) < step / 1e6 ? css('--zero') : css('--grid');
      pen.beginPath(); pen.moveTo(left, y(v)); pen.lineTo(right, y(v)); pen.stroke();
      pen.fillText(`${+v.toPrecision(6)}${this.unit}`, left - 6, y(v));
    }
    pen.textAlign = 'center';
    pen.textBaseline = 'top';
    pen.strokeStyle = css('--grid');
    for (let back = 0; back <= WINDOW; back += 2) {
      const at = x(now - back);
      pen.beginPath(); pen.moveTo(at, top); pen.lineTo(at, bottom); pen.stroke();
      pen.fillText(back ? `−${back} s` : 'now', Math.min(at, right - 12), bottom + 4);
    }
  }
}
