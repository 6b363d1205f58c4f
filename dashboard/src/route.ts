// Where the reader is: #/page/argument?job=2&more. The hash is the only state worth sharing.
import { computed, signal } from '@preact/signals';

const hash = signal(location.hash);
addEventListener('hashchange', () => { hash.value = location.hash; });

export interface Route {
  page: string;
  argument: string;
  query: URLSearchParams;
}

export const route = computed<Route>(() => {
  const [path = '', query = ''] = hash.value.replace(/^#\/?/, '').split('?');
  const [page = '', argument = ''] = path.split('/');
  return { page, argument, query: new URLSearchParams(query) };
});

/** A link that keeps the job. Pass `more` for further parameters; null removes one. */
export function href(path: string, more: Record<string, string | number | null> = {}): string {
  const query = new URLSearchParams();
  const job = route.value.query.get('job');
  if (job) query.set('job', job);
  for (const [key, value] of Object.entries(more)) {
    if (value === null || value === '') query.delete(key);
    else query.set(key, String(value));
  }
  const text = query.toString();
  return `#/${path}${text ? `?${text}` : ''}`;
}

export function go(to: string): void {
  location.hash = to.replace(/^#/, '');
}

/** Changes parameters of the page in place, without a step in the browser's history. */
export function setQuery(more: Record<string, string | number | null>): void {
  const { page, argument, query } = route.value;
  const next = new URLSearchParams(query);
  for (const [key, value] of Object.entries(more)) {
    if (value === null || value === '') next.delete(key);
    else next.set(key, String(value));
  }
  const text = next.toString();
  history.replaceState(null, '', `#/${page}${argument ? `/${argument}` : ''}${text ? `?${text}` : ''}`);
  hash.value = location.hash;
}
