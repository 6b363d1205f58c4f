// The dashboard: header, banners, and the page that the URL names.
import './style.css';
import { render } from 'preact';
import { Shell } from './shell';
import { start } from './live';

start();
render(<Shell />, document.getElementById('app')!);
// Who opens the page on the model waits for its largest file: it is asked for at once, not after the job and the model are known.
if (/^#\/?view\b/.test(location.hash)) void import('./viewer/stage').catch(() => { /* the page says why when it loads it */ });
