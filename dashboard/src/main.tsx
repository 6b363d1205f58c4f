// The dashboard: header, banners, and the page that the URL names.
import './style.css';
import { render } from 'preact';
import { Shell } from './shell';
import { start } from './live';

start();
render(<Shell />, document.getElementById('app')!);
