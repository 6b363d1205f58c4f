// A page whose code comes when it is opened: what only it needs stays out of the first load.
import type { ComponentType } from 'preact';
import { useEffect } from 'preact/hooks';
import { useSignal } from '@preact/signals';
import { Waiting } from './boundary';

export function lazy(load: () => Promise<ComponentType>): ComponentType {
  let known: ComponentType | null = null;
  return function Lazy() {
    const state = useSignal({ ready: known !== null, error: '' });
    useEffect(() => {
      if (known) return;
      load().then((c) => { known = c; state.value = { ready: true, error: '' }; }).catch((e: Error) => { state.value = { ready: false, error: `This page could not be loaded: ${e.message}` }; });
    }, []);
    const Page = known;
    return state.value.ready && Page ? <Page /> : <Waiting error={state.value.error} what="the page" />;
  };
}
