export function Blocks() { return <div class="empty">Blocks</div>; }
