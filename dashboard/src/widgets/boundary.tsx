// A panel: a title, its content, and an error of its own that leaves the others alive.
import { Component, type ComponentChildren } from 'preact';
import { useEffect } from 'preact/hooks';
import { useSignal } from '@preact/signals';
import { get } from '../api';

interface PanelProps {
  title: string;
  aside?: ComponentChildren;
  children: ComponentChildren;
  class?: string;
}

export function Panel({ title, aside, children, class: name }: PanelProps) {
  return (
    <section class={`panel ${name ?? ''}`} aria-label={title}>
      <header><h2>{title}</h2>{aside && <div class="aside">{aside}</div>}</header>
      <Boundary>{children}</Boundary>
    </section>
  );
}

export class Boundary extends Component<{ children: ComponentChildren }, { error: Error | null }> {
  override state = { error: null as Error | null };

  static override getDerivedStateFromError(error: Error) {
    return { error };
  }

  override render() {
    const { error } = this.state;
    if (!error) return this.props.children;
    return (
      <div class="failure" role="alert">
        <b>This panel failed:</b> {error.message}{' '}
        <button type="button" onClick={() => this.setState({ error: null })}>Try again</button>
      </div>
    );
  }
}

export function Empty({ children }: { children: ComponentChildren }) {
  return <div class="empty">{children}</div>;
}

export function Command({ children }: { children: string }) {
  return (
    <div class="command">
      <code>{children}</code>
      <button type="button" aria-label={`Copy: ${children}`} onClick={() => void navigator.clipboard?.writeText(children)}>Copy</button>
    </div>
  );
}

export interface Asked<T> {
  value: T | null;
  error: string;
}

/** GET when `path` or `again` changes; `every` milliseconds besides, if given. null asks nothing. */
export function useGet<T>(path: string | null, again: unknown = 0, every = 0): Asked<T> {
  const state = useSignal<Asked<T> & { path: string | null }>({ value: null, error: '', path: null });
  useEffect(() => {
    if (path === null) return undefined;
    let live = true;
    const ask = async (): Promise<void> => {
      try {
        const value = await get<T>(path);
        if (live) state.value = { value, error: '', path };
      } catch (e) {
        if (live) state.value = { value: state.peek().path === path ? state.peek().value : null, error: (e as Error).message, path };
      }
    };
    void ask();
    const timer = every ? setInterval(() => { if (!document.hidden) void ask(); }, every) : 0;
    return () => { live = false; clearInterval(timer); };
  }, [path, again, every]);
  return state.value.path === path ? state.value : { value: null, error: '' };
}

/** What to show instead of a value that is not there yet. */
export function Waiting({ error, what }: { error: string; what: string }) {
  return error ? <div class="failure" role="alert">{error}</div> : <div class="empty">Loading {what} …</div>;
}
