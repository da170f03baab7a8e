// Colours of the drawings: an attribute `style` in a page is forbidden here, what a script of the server sets is not.
for (const element of document.querySelectorAll("[data-style]")) element.style.cssText = element.dataset.style;
