"""Formulas as MathML, written into the pages when the site is built: browsers draw it without a script or a font from elsewhere."""

import html
import re

from latex2mathml.converter import convert
from mkdocs.exceptions import PluginError

FORMULA = re.compile(r'<(span|div) class="arithmatex">(.*?)</\1>', re.DOTALL)
UNKNOWN = re.compile(r">\s*(\\[a-zA-Z]+)\s*<")
ATOM = r"(<m[io]>[^<]*</m[io]>)"
PRIMED = re.compile(rf"<msup>{ATOM}<mi>&#x02032;</mi></msup>")
PRIMED_BELOW = re.compile(rf"<msubsup>{ATOM}(<m[io]>[^<]*</m[io]>|<mrow>.*?</mrow>)<mi>&#x02032;</mi></msubsup>")
PRIME = r'<mrow>\1<mo lspace="0" rspace="0">&#x02032;</mo></mrow>'
"""A prime is small and high already; as an exponent it would be too small to see."""
WORDS = {r"\arg\max": r"\mathrm{argmax}", r"\arg\min": r"\mathrm{argmin}", r"\operatorname{clip}": r"\mathrm{clip}"}
"""What the converter does not know, in words that it knows."""


def on_page_content(content: str, **_: object) -> str:
    """Replace what `pymdownx.arithmatex` marked."""
    return FORMULA.sub(lambda match: _mathml(html.unescape(match[2]).strip()), content)


def _mathml(marked: str) -> str:
    text = marked[2:-2].strip()  # without \( \) or \[ \]
    for word, other in WORDS.items():
        text = text.replace(word, other)
    formula = convert(text)
    formula = PRIMED_BELOW.sub(rf"<msub>{PRIME}\2</msub>", PRIMED.sub(PRIME, formula))
    unknown = UNKNOWN.search(formula)
    if unknown:
        raise PluginError(f"{unknown[1]} in the formula {text} cannot be turned into MathML: write it otherwise")
    if marked.startswith(r"\("):
        return formula
    block = formula.replace('display="inline"', 'display="block"', 1)
    return f'<div class="formula">{block}</div>'
