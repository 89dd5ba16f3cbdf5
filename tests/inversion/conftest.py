"""Fixtures of the tests of inversion networks."""

import pytest

from bench.inversion.network import Shape


@pytest.fixture
def narrow_networks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Narrower embeddings than the defaults, because the optimizer spends its time on them."""
    for name, width in {"hidden": 32, "painted": 4}.items():
        monkeypatch.setitem(Shape.__init__.__kwdefaults__, name, width)  # type: ignore[arg-type]
