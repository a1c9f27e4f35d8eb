// Shows a report in the language of the browser; a button shows the other one. The studio says its
// language and its colours in the address. Each picture is a button that opens it as large as it is
// stored; Escape or a click closes it, and the arrow keys show the next one. Without scripts, the
// report is in English, and its pictures remain small. The script is part of a well-formed document,
// so it contains neither "less than" nor "and".
{
    const wanted = new URLSearchParams(location.search);
    document.documentElement.style.colorScheme = wanted.get("theme") ?? "";
    const button = document.body.appendChild(document.createElement("button"));
    button.className = "language";
    const speak = chinese => {
        document.documentElement.lang = chinese ? "zh-CN" : "en";
        button.textContent = chinese ? "English" : "中文";
        button.onclick = () => speak(!chinese);
    };
    speak((wanted.get("lang") ?? navigator.language).toLowerCase().startsWith("zh"));
}
{
    const pictures = [...document.querySelectorAll("main img")];
    const dialog = document.body.appendChild(document.createElement("dialog"));
    const large = dialog.appendChild(new Image());
    large.alt = "";
    const name = dialog.appendChild(document.createElement("p"));
    let shown = 0;
    const show = number => {
        shown = (number + pictures.length) % pictures.length;
        large.src = pictures[shown].src;
        name.textContent = large.alt = pictures[shown].alt;
        if (!dialog.open) dialog.showModal();
    };
    pictures.forEach((picture, number) => {
        picture.tabIndex = 0;
        picture.setAttribute("role", "button");
        picture.onclick = () => show(number);
        picture.onkeydown = event => {
            if (!["Enter", " "].includes(event.key)) return;
            event.preventDefault();
            show(number);
        };
    });
    dialog.onclick = () => dialog.close();
    dialog.onkeydown = event => {
        const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
        if (by) show(shown + by);
    };
}
