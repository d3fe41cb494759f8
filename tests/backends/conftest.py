"""Libraries of learned models that may not be there."""

import pytest


@pytest.fixture(scope="module")
def transformers():
    pytest.importorskip("safetensors", reason="safetensors is not installed")
    library = pytest.importorskip("transformers", reason="transformers is not installed")
    try:
        _ = (
            library.Sam2VideoModel, library.Sam3VideoModel, library.DepthAnythingForDepthEstimation,
            library.DepthProForDepthEstimation,
        )  # fmt: skip
    except (ImportError, RuntimeError, OSError) as error:
        pytest.skip(f"transformers does not start: does torchvision fit torch? ({str(error).splitlines()[0]})")
    return library
