// What this browser remembers: theme and motion.
import { effect, signal } from '@preact/signals';

export type Theme = 'system' | 'light' | 'dark';

export const theme = signal<Theme>((read('theme') as Theme | null) ?? 'system');
export const calm = signal(read('calm') === '1');

const systemDark = matchMedia('(prefers-color-scheme: dark)');
const systemCalm = matchMedia('(prefers-reduced-motion: reduce)');
const system = signal({ dark: systemDark.matches, calm: systemCalm.matches });
for (const query of [systemDark, systemCalm]) {
  query.addEventListener('change', () => { system.value = { dark: systemDark.matches, calm: systemCalm.matches }; });
}

/** For canvases, which CSS does not reach. */
export const dark = signal(false);
export const still = signal(false);

effect(() => {
  dark.value = theme.value === 'dark' || (theme.value === 'system' && system.value.dark);
  still.value = calm.value || system.value.calm;
  document.documentElement.dataset['theme'] = dark.value ? 'dark' : 'light';
  document.documentElement.dataset['calm'] = still.value ? '1' : '0';
  write('theme', theme.value);
  write('calm', calm.value ? '1' : '0');
});

function read(key: string): string | null {
  try { return localStorage.getItem(`plat.${key}`); } catch { return null; }
}

function write(key: string, value: string): void {
  try { localStorage.setItem(`plat.${key}`, value); } catch { /* a browser that stores nothing still shows everything */ }
}
