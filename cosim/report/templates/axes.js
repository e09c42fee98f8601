// Axes of what a chart is zoomed to, by the rules of svg.py; a test holds the two against each other.
/* exported axis, logAxis */

const MINUS = "\u2212";

function roundStep(least, angle) {
  if (angle && least > 10 && least <= 360) return [15, 30, 45, 90, 180, 360].find((part) => part >= least);
  const power = 10 ** Math.floor(Math.log10(least));
  return power * ([1, 2, 2.5, 5].find((m) => m * power >= least * (1 - 1e-9)) ?? 10);
}

function axis(low, high, number, angle = false) {
  if (high - low <= 1e-9 * Math.max(Math.abs(low), Math.abs(high))) {
    const room = 0.1 * Math.abs(low) || 1;
    [low, high] = [low - room, high + room];
  }
  const step = roundStep((high - low) / number, angle);
  const largest = Math.max(Math.abs(low), Math.abs(high));
  const power = largest >= 1e-3 && largest < 1e6 ? 0 : 3 * Math.floor(Math.log10(largest) / 3 + 1e-9);
  const unit = step / 10 ** power;
  let decimals = Math.max(0, -Math.floor(Math.log10(unit) + 1e-9));
  if (Math.abs(unit * 10 ** decimals - Math.round(unit * 10 ** decimals)) > 1e-6) decimals++;
  const ticks = [];
  for (let i = Math.ceil(low / step - 1e-9); i <= Math.floor(high / step + 1e-9); i++) {
    const label = (i * unit || 0).toFixed(Math.min(decimals, 20)).replace("-", MINUS);
    ticks.push({ at: (100 * (i * step - low)) / (high - low), label });
  }
  const raised = String(power).replace(/./g, (c) => "⁰¹²³⁴⁵⁶⁷⁸⁹⁻"["0123456789-".indexOf(c)]);
  return { low, high, ticks, factor: power ? `×10${raised}` : "" };
}

// Over 10^low … 10^high: decades, or in fewer than two what is round between them.
function logAxis(low, high) {
  const every = Math.max(1, Math.ceil((high - low) / 8));
  const first = Math.floor(low);
  const all = Array.from({ length: Math.ceil(high) - first + 1 }, (_, k) => first + k);
  const decades = all.filter((d) => d % every === 0);
  const at = (value) => (100 * (Math.log10(value) - low)) / (high - low);
  const short = (value) => {
    const digits = Number(value.toPrecision(6));
    const text = digits >= 1e-4 && digits < 1e6 ? String(digits) : digits.toExponential().replace("+", "");
    return text.replace("-", MINUS);
  };
  for (const parts of [[1], [1, 2, 5], [1, 2, 3, 4, 5, 6, 7, 8, 9]]) {
    const values = decades.flatMap((d) => parts.map((m) => m * 10 ** d));
    const ticks = values.filter((v) => at(v) > -1e-7 && at(v) < 100 + 1e-7);
    if (ticks.length >= 3) return { low, high, ticks: ticks.map((v) => ({ at: at(v), label: short(v) })), factor: "" };
  }
  const linear = axis(10 ** low, 10 ** high, 6);
  const value = (tick) => linear.low + (tick.at / 100) * (linear.high - linear.low);
  return { ...linear, low, high, ticks: linear.ticks.map((t) => ({ at: at(value(t)), label: t.label })) };
}
