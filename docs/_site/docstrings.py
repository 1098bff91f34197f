"""The source as it is, turned into what the pages of names are made of.

Settings are declared with their documentation; of these a signature shall show the default alone.
"""

from __future__ import annotations

from typing import Any

from docstring_text import rewritten
from griffe import Attribute, Docstring, ExprCall, Extension, Function, Object


class SourceAsItIs(Extension):
    """Rewrites docstrings, and the defaults of settings."""

    def on_attribute_instance(self, *, attr: Attribute, **kwargs: Any) -> None:
        """Let `setting(default, doc)` be its default, and `section(Config, doc)` a `Config()`."""
        if isinstance(attr.value, ExprCall) and str(attr.value.function) in ("setting", "section"):
            first = attr.value.arguments[0]
            is_class = str(attr.value.function) == "section" and str(first).isidentifier()
            attr.value = ExprCall(first, []) if is_class else first

    def on_object(self, *, obj: Object, **kwargs: Any) -> None:
        """Rewrite one docstring."""
        if obj.docstring is not None:
            old, returns = obj.docstring, str(obj.returns) if isinstance(obj, Function) else ""
            obj.docstring = Docstring(
                rewritten(old.value, returns), lineno=old.lineno, endlineno=old.endlineno, parent=obj,
                parser=old.parser, parser_options=old.parser_options,
            )  # fmt: skip
