// Copy buttons, and larger images: the page is complete without them.
for (const pre of document.querySelectorAll('.copybox pre')) {
  const button = document.createElement('button');
  button.textContent = 'Copy';
  button.onclick = async () => {
    getSelection().selectAllChildren(pre.firstElementChild);
    try { await navigator.clipboard.writeText(pre.textContent); } catch { document.execCommand('copy'); }
    button.textContent = 'Copied';
  };
  pre.after(button);
}
const large = document.createElement('dialog');
large.onclick = () => large.close();
document.body.append(large);
for (const row of document.querySelectorAll('.row')) {
  const open = () => { large.replaceChildren(row.cloneNode(true)); large.showModal(); };
  row.onclick = open;
  row.onkeydown = event => { if (event.key === 'Enter') open(); };
  row.tabIndex = 0;
  row.title = 'Enlarge';
}
