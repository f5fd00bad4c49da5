"""Pages that are one file: escaped throughout, styles and scripts inside, nothing else allowed."""

from __future__ import annotations

import base64
import hashlib
from functools import lru_cache
from importlib.resources import files
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

from geodelreg.errors import MissingExtraError, shown

if TYPE_CHECKING:
    from jinja2 import Environment


def check_jinja(name: str) -> None:
    """Refuse a page that cannot be made, before there is anything to show.

    Parameters
    ----------
    name : str
        Of the page, for the message.

    Raises
    ------
    MissingExtraError
    """
    if find_spec("jinja2") is None:
        raise MissingExtraError(
            f"{name}: pages of HTML need Jinja, which is not installed",
            "Install it: pip install jinja2 (in a clone: pip install '.[report]').",
        )


def render(template: str, styles: list[str], scripts: list[str], **values: Any) -> str:
    """A page.

    Parameters
    ----------
    template : str
        Name of a template beside this module.
    styles, scripts : list of str
        Names of files beside this module.  They alone apply and run: the page says so in a content
        security policy with their digests.
    **values
        Whatever a file or a band is called is escaped, and what would steer the text is shown.
    """
    from markupsafe import Markup

    style, script = ("".join(map(_text, names)) for names in (styles, scripts))
    policy = (
        f"default-src 'none'; img-src data:; style-src '{_digest(style)}'; "
        f"script-src '{_digest(script)}'; base-uri 'none'; form-action 'none'"
    )
    page = _environment().get_template(template)
    return page.render(
        values | {"policy": policy, "style": Markup(style), "script": Markup(script)}
    )


def _digest(text: str) -> str:
    return "sha256-" + base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


def _text(name: str) -> str:
    return files("geodelreg.report").joinpath("templates", name).read_text("utf-8")


@lru_cache(maxsize=1)
def _environment() -> Environment:
    from jinja2 import Environment, FunctionLoader, StrictUndefined
    from markupsafe import Markup

    def visible(value: Any) -> Any:
        """Text as it is, but for marks that turn its direction or steer a terminal."""
        plain = isinstance(value, str) and not isinstance(value, Markup)
        return shown(value) if plain else value

    return Environment(
        loader=FunctionLoader(_text),
        autoescape=True,
        undefined=StrictUndefined,
        finalize=visible,
        trim_blocks=True,
        lstrip_blocks=True,
    )
