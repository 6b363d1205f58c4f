// Colours of states, numbers and workers. Okabe and Ito's set: told apart with any colour vision; a glyph says it too.
import { dark } from './settings';

// By state: waiting, ready, running, done, failed, quarantined.
export const STATE_LIGHT = ['#c3c8cf', '#9bd0f0', '#0072b2', '#009e73', '#d55e00', '#a8558a'];
export const STATE_DARK = ['#414851', '#2f6f94', '#3a9bdc', '#0f9d76', '#e8701a', '#c67fae'];
export const GLYPHS = ['·', '○', '▶', '✓', '✕', '⊘'];
export const WORKERS = ['#0072b2', '#e69f00', '#009e73', '#cc79a7', '#56b4e9', '#d55e00', '#8a8f00', '#7a6fd0'];

export function stateColours(): string[] {
  return dark.value ? STATE_DARK : STATE_LIGHT;
}

const RAMP: [number, number, number][] = [[20, 42, 92], [0, 92, 148], [0, 142, 150], [92, 184, 116], [240, 228, 66]];

/** 0..1 to a colour, dark blue to yellow, monotone in lightness. */
export function ramp(share: number): string {
  const at = Math.max(0, Math.min(1, share)) * (RAMP.length - 1);
  const i = Math.min(RAMP.length - 2, Math.floor(at));
  const mix = [0, 1, 2].map((k) => Math.round(RAMP[i]![k]! + (RAMP[i + 1]![k]! - RAMP[i]![k]!) * (at - i)));
  return `rgb(${mix.join(',')})`;
}

export function workerColour(name: string): string {
  let h = 0;
  for (let i = 0; i < name.length; i += 1) h = (h * 31 + name.charCodeAt(i)) >>> 0;
  return WORKERS[h % WORKERS.length]!;
}

const read = new Map<string, string>();

/** A colour of the style sheet, for canvases. Remembered: canvases ask for each block. */
export function css(name: string): string {
  const key = `${name} ${dark.peek()}`;
  let value = read.get(key);
  if (value === undefined) read.set(key, value = getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim());
  return value;
}
