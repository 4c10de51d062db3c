// The state of a page stands in its address, behind #, so that a link shows what its sender saw.
"use strict";
ClosedLap.state = (function () {
  const listeners = [];

  // A fragment without "=" names a place in the page and says nothing about its state.
  function read() {
    const text = location.hash.slice(1);
    return new URLSearchParams(text.includes("=") ? text : "");
  }

  let now = read();
  let timer = null;

  function get(key, fallback) {
    const value = now.get(key);
    return value === null ? fallback : value;
  }

  // Browsers refuse an address that changes too often, as a slider would make it.
  function write() {
    timer = null;
    const text = now.toString();
    history.replaceState(null, "", text ? `#${text}` : location.href.split("#")[0]);
  }

  // Change some of the state; null, or "", takes a key out.
  function set(changes) {
    for (const [key, value] of Object.entries(changes)) {
      if (value === null || value === undefined || value === "") now.delete(key);
      else now.set(key, value);
    }
    if (timer === null) timer = setTimeout(write, 150);
    for (const listener of listeners) listener();
  }

  window.addEventListener("hashchange", () => {
    if (location.hash && !location.hash.includes("=")) return;
    now = read();
    for (const listener of listeners) listener();
  });
  window.addEventListener("pagehide", () => {
    if (timer !== null) write();
  });

  function listen(listener) {
    listeners.push(listener);
  }

  // Make an element with properties and children; children are nodes or text, never markup.
  function make(tag, properties, ...children) {
    const element = document.createElement(tag);
    for (const [name, value] of Object.entries(properties || {})) {
      if (name in element) element[name] = value;
      else element.setAttribute(name, value);
    }
    element.append(...children);
    return element;
  }

  ClosedLap.make = make;
  return { get, set, listen };
})();
