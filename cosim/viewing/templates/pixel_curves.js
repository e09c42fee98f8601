// Curves as pixels. A browser strokes a hundred paths of extremes in seconds, and fills their columns in milliseconds.
/* exported paintCurves */

const DASH = [6, 4]; // pixels with and without ink

// Each curve has data (t, low, high), the scale y of its axis and its pen.
function paintCurves(canvas, size, curves, x) {
  const ratio = devicePixelRatio || 1,
    width = Math.max(1, Math.round(size.width * ratio)),
    height = Math.max(1, Math.round(size.height * ratio));
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height }); // a new surface
  const context = canvas.getContext("2d"),
    picture = context.createImageData(width, height),
    extremes = { top: new Float32Array(width), bottom: new Float32Array(width) };
  for (const { data, y, pen } of curves) {
    columnsOf(data, x, y, height, extremes);
    context.fillStyle = pen.stroke; // in any notation; it is read back as #rrggbb
    const dash = pen["stroke-dasharray"] === "none" ? null : DASH.map((length) => length * ratio);
    fillColumns(picture, extremes, context.fillStyle, (Number(pen["stroke-width"]) * ratio) / 2, dash);
  }
  context.putImageData(picture, 0, 0);
}

// The highest and the lowest place of a curve in each column of pixels; a column without the curve has top > bottom.
function columnsOf({ t, low, high }, x, y, height, { top, bottom }) {
  const width = top.length,
    along = width / (x.high - x.low),
    upward = height / (y.high - y.low);
  top.fill(Infinity);
  bottom.fill(-Infinity);
  let before = NaN,
    from = 0;
  for (let n = 0; n < t.length; n++) {
    const place = (t[n] - x.low) * along,
      near = height - (low[n] - y.low) * upward,
      far = height - (high[n] - y.low) * upward,
      isTurned = Math.abs(far - before) < Math.abs(near - before);
    const first = isTurned ? far : near;
    if (!Number.isNaN(before + first) && place >= 0 && from < width) {
      const slope = place > from ? (first - before) / (place - from) : 0,
        end = Math.min(width - 1, Math.floor(place));
      for (let k = Math.max(0, Math.floor(from)); k <= end; k++) {
        const one = before + slope * (Math.max(from, k) - from),
          other = before + slope * (Math.min(place, k + 1) - from);
        top[k] = Math.min(top[k], one, other);
        bottom[k] = Math.max(bottom[k], one, other);
      }
    }
    const k = Math.floor(place);
    if (!Number.isNaN(near) && k >= 0 && k < width) {
      top[k] = Math.min(top[k], far);
      bottom[k] = Math.max(bottom[k], near);
    }
    before = isTurned ? near : far;
    from = place;
  }
}

// Ink from half a line above the top to half a line below the bottom; pixels at the ends are covered in part.
function fillColumns({ data, width, height }, { top, bottom }, colour, half, dash) {
  const words = new Uint32Array(data.buffer),
    [red, green, blue] = [1, 3, 5].map((k) => parseInt(colour.slice(k, k + 2), 16)),
    ink = (blue << 16) | (green << 8) | red;
  for (let k = 0; k < width; k++) {
    if (top[k] > bottom[k] || (dash && k % (dash[0] + dash[1]) >= dash[0])) continue;
    const high = top[k] - half,
      low = bottom[k] + half,
      end = Math.min(height, Math.ceil(low));
    for (let row = Math.max(0, Math.floor(high)); row < end; row++) {
      const at = row * width + k,
        share = Math.min(low, row + 1) - Math.max(high, row);
      if (share >= 1) words[at] = (255 << 24) | ink;
      else if (words[at] === 0) words[at] = (Math.round(255 * share) << 24) | ink;
      else {
        const place = 4 * at,
          under = (data[place + 3] / 255) * (1 - share),
          whole = share + under;
        data[place] = (red * share + data[place] * under) / whole;
        data[place + 1] = (green * share + data[place + 1] * under) / whole;
        data[place + 2] = (blue * share + data[place + 2] * under) / whole;
        data[place + 3] = 255 * whole;
      }
    }
  }
}
