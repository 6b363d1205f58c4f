export function View() { return <div class="empty">View</div>; }
