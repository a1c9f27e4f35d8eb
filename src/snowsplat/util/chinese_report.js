// Shows a report in Chinese in a browser in Chinese; a button shows the English again. The studio says
// its language and its colours in the address. The script is part of a well-formed document, after
// `chinese.js`.
{
    const texts = [];
    const walker = document.createTreeWalker(document.querySelector('main'), NodeFilter.SHOW_TEXT);
    while (walker.nextNode()) {
        const node = walker.currentNode;
        if (node.parentElement.closest('h1, pre')) continue; // a name, or a command
        const english = node.data.trim();
        const chinese = snowsplatChinese(english);
        if (chinese !== english) texts.push([node, node.data, chinese]);
    }
    const button = document.body.appendChild(document.createElement('button'));
    button.className = 'language';
    const show = (chinese) => {
        document.documentElement.lang = chinese ? 'zh-CN' : 'en';
        button.textContent = chinese ? 'English' : '中文';
        button.onclick = () => show(!chinese);
        for (const [node, english, other] of texts) node.data = chinese ? other : english;
    };
    const wanted = new URLSearchParams(location.search);
    document.documentElement.style.colorScheme = wanted.get('theme') ?? '';
    show((wanted.get('lang') ?? navigator.language).toLowerCase().startsWith('zh'));
}
