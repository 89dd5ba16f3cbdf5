"""Extensions of the site's build: files outside `docs/` that its pages link to, and comments of fields as documentation."""

from __future__ import annotations

import ast
import posixpath
import re
import tokenize
from pathlib import Path
from typing import Any

from griffe import Attribute, Class, Extension, Function, Module, ObjectNode
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

LINK = re.compile(r"(?<=\]\()[^)\s#:]+")  # the path of a relative link
OUTSIDE, INSIDE = "../", "../docs/"  # how the paths of files begin that are relative to `docs/`


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add the files outside `docs/` that pages link to: Markdown as pages, all others as text."""
    pages = [file for file in files if file.is_documentation_page()]
    for page in pages:
        for link in LINK.findall(page.content_string):
            path = _resolve(page.src_uri, link)
            missing = path.startswith(OUTSIDE) and not path.startswith(INSIDE) and path not in files.src_uris
            if missing and Path(config.docs_dir, path).is_file():
                stem, suffix = posixpath.splitext(path.removeprefix(OUTSIDE))
                destination = stem + (".html" if suffix == ".md" else f"{suffix}.txt")
                file = File(
                    path,
                    config.docs_dir,
                    config.site_dir,
                    config.use_directory_urls,
                    dest_uri=f"repository/{destination}",
                    inclusion=InclusionLevel.INCLUDED,
                )
                files.append(file)
                pages += [file] if file.is_documentation_page() else []  # whose links are followed too
    return files


def on_page_markdown(markdown: str, *, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Return a page from outside `docs/` with its links into `docs/` as MkDocs resolves them.

    A link to a folder leads to the folder's first page in the navigation.
    """

    def resolve(link: re.Match[str]) -> str:
        path = _resolve(page.file.src_uri, link[0])
        if not path.startswith(INSIDE):
            return link[0]
        path = path.removeprefix(INSIDE)
        first = re.search(rf"'({re.escape(path)}/[^']+)'", str(config.nav))
        return f"/{first[1] if first else path}"

    return LINK.sub(resolve, markdown) if page.file.src_uri.startswith(OUTSIDE) else markdown


def _resolve(page: str, link: str) -> str:
    return posixpath.normpath(posixpath.join(posixpath.dirname(page), link))


class ApiReference(Extension):
    """Lists fields with their comments, hides the helpers in a plugin's module, and reads parameters as `name : meaning`."""

    def on_class_members(self, *, node: ast.AST | ObjectNode, cls: Class, **kwargs: Any) -> None:
        if cls.docstring is None:
            return
        is_dataclass = any("dataclass" in str(decorator.value) for decorator in cls.decorators)
        sections: dict[str, list[str]] = {"Parameters": [], "Attributes": []}
        for field in cls.members.values():
            if isinstance(field, Attribute) and field.is_public and not field.has_docstring and "property" not in field.labels:
                is_parameter = is_dataclass and field.annotation is not None and "instance-attribute" in field.labels
                value = "" if is_parameter or field.value is None else f"`{field.value}`"
                entry = f"{field.name}\n    {find_comment(cls, field) or value}"
                sections["Parameters" if is_parameter else "Attributes"].append(entry)
        for title, entries in sections.items():
            if entries and f"{title}\n---" not in cls.docstring.value:
                cls.docstring.value += "\n\n" + "\n".join([title, "-" * len(title), *entries])

    def on_function_instance(self, *, node: ast.AST | ObjectNode, func: Function, **kwargs: Any) -> None:
        if func.docstring is not None:
            func.docstring.value = re.sub(r"^([a-z_, ]+) : (.+)", r"\1\n    \2", func.docstring.value, flags=re.MULTILINE)

    def on_module_members(self, *, node: ast.AST | ObjectNode, mod: Module, **kwargs: Any) -> None:
        plugin = mod.members.get("PLUGIN")
        if isinstance(plugin, Attribute):
            for name, member in mod.members.items():
                member.public = name == str(plugin.value)


def find_comment(cls: Class, field: Attribute) -> str:
    """Return the comment in the lines of a field, or else the comment lines above it; empty if there is none."""
    lines = [line.strip() for line in cls.lines]
    first = start = (field.lineno or 0) - (cls.lineno or 0)
    last = (field.endlineno or 0) - (cls.lineno or 0) + 1
    source = iter([f"{line}\n" for line in lines[first:last]])
    comments = [token.string for token in tokenize.generate_tokens(source.__next__) if token.type == tokenize.COMMENT]
    while not comments and lines[start - 1].startswith("# "):
        start -= 1
    return " ".join(comment.removeprefix("# ") for comment in comments or lines[start:first])
