// The elements of the page.

/** @param {string} id @returns {any} the element, of the type that `index.html` gives to it */
export const byId = id => document.getElementById(id);

/** Show the value of a slider beside it. @param {HTMLInputElement} slider */
export const showValue = slider => {
    const output = slider.parentElement?.querySelector("output");
    if (output) output.value = slider.value;
};

/** Lines of plain text. @param {HTMLElement} element @param {string[]} lines */
export const showLines = (element, lines) => {
    if ([...element.children].map(line => line.textContent).join("\n") !== lines.join("\n"))
        element.replaceChildren(
            ...lines.map(line => Object.assign(document.createElement("p"), { textContent: line })),
        );
};

/** The present colours of the page: dark or light. */
export const isDark = () => {
    const chosen = document.documentElement.dataset.theme;
    return chosen ? chosen === "dark" : !matchMedia("(prefers-color-scheme: light)").matches;
};
