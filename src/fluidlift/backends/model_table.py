"""The learned models that `fluidlift models` knows: one card each, the advised one of each kind first.

Sizes and SHA-256 are those that the hub shows for the pinned revision, and that several users of these very files
have published independently of each other; nothing was made up: what could not be found that way is not known.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import NamedTuple

from fluidlift.backends.model_card import ModelCard, ModelFile, Terms
from fluidlift.errors import InputRejected

LEARNED = "pip install 'fluidlift[learned]'"
MOGE_COMMIT = "925b8ed835a7a9cdb7578ba15c658a0afc969030"
"""of MoGe's own code: the last one of its second version, whose weights these are; the third needs other packages"""
MOGE = f"pip install git+https://github.com/microsoft/MoGe.git@{MOGE_COMMIT}"
DA3 = "pip install git+https://github.com/ByteDance-Seed/Depth-Anything-3.git@3d835ec1a5802d64a8b8b15f817a1ab54809bfe4"
_PAIR = "50 to 200 times our own flow"


class _Hub(NamedTuple):
    """A repository on Hugging Face at one revision."""

    name: str
    revision: str

    def file(self, name: str, size: int | None = None, sha256: str | None = None) -> ModelFile:
        """One of its files."""
        return ModelFile(name, f"https://huggingface.co/{self.name}/resolve/{self.revision}/{name}", size, sha256)

    @property
    def page(self) -> str:
        """For people."""
        return f"https://huggingface.co/{self.name}"


_MOGE_SMALL = _Hub("Ruicheng/moge-2-vits-normal", "679230677b4d282c6f304189a93e98e14f085902")
_MOGE_BASE = _Hub("Ruicheng/moge-2-vitb-normal", "54ad3a693e61907ea4633d13dec6ee682fa09419")
_MOGE_ONNX = _Hub("Ruicheng/moge-2-vits-normal-onnx", "e50ffda41565591092adea54c6ac83d6212e1e23")
_SAM2 = _Hub("facebook/sam2.1-hiera-tiny", "de431c4043854a71d8101e17995dfe596bf101a5")
_SEA_RAFT = _Hub("MemorySlices/Tartan-C-T-TSKH-spring540x960-M", "eb97ef34ba5d856c3fa2cdcd073150c057ac8b69")
_DA2 = _Hub("depth-anything/Depth-Anything-V2-Small-hf", "5426e4f0f36572d16453bbda7a8389317b1bef99")
_DA3 = _Hub("depth-anything/DA3METRIC-LARGE", "4010e39f3634a45bc60553321fb49fb760bd594e")
_DEPTH_PRO = _Hub("apple/DepthPro-hf", "main")
_RAFT = "https://download.pytorch.org/models/"
_MOGE_TERMS = "Code and weights are MIT (Microsoft), its encoder DINOv2 Apache-2.0 (Meta)."
_RAFT_TERMS = (
    "The code is BSD-3 (torchvision). The licence of the weights is not clear for commercial use: they were trained on "
    "research data sets, and the question was never answered. Take them for research, or ask a lawyer."
)

MODELS: tuple[ModelCard, ...] = (
    ModelCard(
        "moge-2-vits-normal", "MoGe-2, small, with normals (Wang et al. 2025)", ("depth", "tilt", "focal length"),
        ("depth model", "moge"), _MOGE_TERMS, "allowed", _MOGE_SMALL.page,
        (_MOGE_SMALL.file(
            "model.pt", 140_550_416, "79a16621928c2bf0ed04659218c55c01075e950507f40bb3332fb4c873d3e1dc"
        ),),
        ("moge",), MOGE,
        notes=("35 million parameters: the one to begin with. Depth in metres, the field of view, and which way each "
               "surface faces, which tells the camera's tilt.",),
    ),
    ModelCard(
        "moge-2-vitb-normal", "MoGe-2, middle, with normals (Wang et al. 2025)", ("depth", "tilt", "focal length"),
        ("depth model", "moge"), _MOGE_TERMS, "allowed", _MOGE_BASE.page,
        (_MOGE_BASE.file(
            "model.pt", 419_110_160, "16b8110e86d5dc5a849db120ca96ef3a223fd30b0c9146d1d81db504073da5f6"
        ),),
        ("moge",), MOGE, notes=("As the small one, with 104 million parameters.",),
    ),
    ModelCard(
        "moge-2-vits-normal-onnx", "MoGe-2, small, with normals, as an ONNX file (Wang et al. 2025)",
        ("depth", "tilt", "focal length"), ("depth model", "moge-onnx"), _MOGE_TERMS, "allowed", _MOGE_ONNX.page,
        (_MOGE_ONNX.file(
            "model.onnx", 140_852_051, "24eacb5dc7a2c54c7bc98f7de085ffbed79ad006ea5b664c2c2cdc02ff3a52f0"
        ),),
        ("onnxruntime",), "pip install 'fluidlift[onnx]'",
        notes=("The small one by ONNX Runtime, which comes from the package registry. Its page names no licence; that "
               "of the same weights as a checkpoint is MIT.",),
    ),
    ModelCard(
        "geocalib", "GeoCalib (Veicht et al. 2024)", ("tilt", "focal length"), ("view model", "geocalib"),
        "The authors' code is Apache-2.0, and none of it is needed; their weights are CC BY 4.0: every use is allowed, "
        "with their names (Veicht, Sarlin, Lindenberger, Pollefeys: GeoCalib, ECCV 2024).",
        "allowed", "https://github.com/cvg/GeoCalib",
        (ModelFile("geocalib-pinhole.tar", "https://github.com/cvg/GeoCalib/releases/download/v1.0/geocalib-pinhole.tar",
                   116_074_121, "86d6aeacd8bbd974c59ce39f61854e00d36911c732ad89be471476fd708722ac"),),
        cpu="5 s a picture (one core)",
        notes=("One more witness of how the camera stands, for every kind of fluid, beside any model of depth.",),
    ),
    ModelCard(
        "depth-anything-v2-small", "Depth Anything V2, small (Yang et al. 2024)", ("depth",),
        ("depth model", "depth-anything"), "Code and weights of this size are Apache-2.0.", "allowed", _DA2.page,
        (_DA2.file("config.json", 950, "c56698d3643dde1f83ea2212759e6b31a22b8f827246a36dd007ee8a22b3ff75"),
         _DA2.file("model.safetensors", 99_173_660,
                   "3152477ce0d8d6978d76b995120de97cb5b928701fd0f817769f59e249a16b70")),
        ("transformers",), LEARNED, notes=("Disparity only: neither metres nor a field of view.",),
    ),
    ModelCard(
        "da3metric-large", "Depth Anything 3, metric (Lin et al. 2025)", ("depth",),
        ("depth model", "depth-anything-3"),
        "Code and weights of this model are Apache-2.0 (ByteDance).", "allowed", _DA3.page,
        (_DA3.file("config.json", 847, "a336f3e76fe375aaae17a9aed9130c9f2aa061535d317ec57dcb2f1f02e1dd53"),
         _DA3.file("model.safetensors", 1_336_734_448,
                   "bbea5b0b3ee389849cffa7ddae89de064a90abd2b055fc5aa99aac68db324776")),
        ("depth_anything_3",), DA3, notes=("Metres where the camera is known, else depth up to a factor.",),
    ),
    ModelCard(
        "depth-pro", "Depth Pro (Bochkovskii et al. 2024, Apple)", ("depth", "focal length"),
        ("depth model", "depth-pro"),
        "Apple's own licences; that of the weights (apple-amlr) allows research only.", "research", _DEPTH_PRO.page,
        (_DEPTH_PRO.file("config.json"), _DEPTH_PRO.file("model.safetensors")), ("transformers",), LEARNED,
        notes=("Neither its size nor its hashes are known here, and the revision is the newest one.",),
    ),
    ModelCard(
        "sam2.1-hiera-tiny", "SAM 2.1, tiny (Ravi et al. 2024, Meta)", ("masks",), ("mask method", "sam2"),
        "Code and weights are Apache-2.0 (Meta).", "allowed", _SAM2.page,
        (_SAM2.file("config.json", 5_695, "860aff9751b139d83a4ad7df1e5535416fded533e0ead02625edbefcb9953cce"),
         _SAM2.file("model.safetensors", 155_908_064,
                    "48c14467e5cf9e51870511feb72c89688e82dd74523142c0538b663e193ac2a7")),
        ("transformers",), LEARNED, "tens of seconds a frame",
        notes=("Begins with what our own segmentation is surest of, and follows it.",),
    ),
    ModelCard(
        "sam3", "SAM 3 (Meta 2025)", ("masks",), ("mask method", "sam3"),
        "Meta's own SAM License; the weights are handed out on request. Read that licence before you use them.",
        "conditions", "https://huggingface.co/facebook/sam3",
        tuple(ModelFile(name, "") for name in ("config.json", "model.safetensors", "tokenizer.json")),
        ("transformers", "torchvision"), LEARNED,
        notes=("Looks for words (segment.words). Ask Meta for it on its page, then bring the files with --from.",),
    ),
    ModelCard(
        "sea-raft-spring-m", "SEA-RAFT M, for footage (Wang, Lipson, Deng 2024)", ("flow",),
        ("flow method", "sea-raft"),
        "The authors' code is BSD-3, and the same is assumed of their weights. Those were trained on data sets some "
        "of which are for research only: take them for research, or ask a lawyer.",
        "conditions", _SEA_RAFT.page,
        (_SEA_RAFT.file("model.safetensors", 78_778_760,
                        "cb8cfbf14c5e0f6734b64add383708b7ff68cc6089a0007c67165d4761346102"),),
        ("safetensors",), LEARNED, _PAIR, notes=("Says itself how sure it is of each pixel.",),
    ),
    ModelCard(
        "raft-large", "RAFT, large, by torchvision (Teed, Deng 2020)", ("flow",), ("flow method", "raft"),
        _RAFT_TERMS, "conditions", "https://docs.pytorch.org/vision/stable/models/raft.html",
        (ModelFile("raft_large_C_T_SKHT_V2-ff5fadd5.pth", f"{_RAFT}raft_large_C_T_SKHT_V2-ff5fadd5.pth", 21_106_607,
                   "ff5fadd56d26b40647388883af1547351ea17868b765c05b27231e72dd16a322"),),
        ("torchvision",), LEARNED, _PAIR,
    ),
    ModelCard(
        "raft-small", "RAFT, small, by torchvision (Teed, Deng 2020)", ("flow",), ("flow method", "raft"),
        _RAFT_TERMS, "conditions", "https://docs.pytorch.org/vision/stable/models/raft.html",
        (ModelFile("raft_small_C_T_V2-01064c6d.pth", f"{_RAFT}raft_small_C_T_V2-01064c6d.pth", 4_006_189,
                   "01064c6dba73b0fc9fc8edf772248560a00a3acfd62ac6677e9eeebad9680e27"),),
        ("torchvision",), LEARNED, _PAIR,
    ),
)  # fmt: skip
"""cards of models whose files are fetched; generators have their own environments and cards (`every_model`)"""

_BODY_TERMS: dict[str, Terms] = {"triposplat": "conditions"}
"""generators whose cards know only that commercial use is not simply allowed"""


def every_model() -> tuple[ModelCard, ...]:
    """All cards: `MODELS`, then the generators, whose weights their own environments fetch."""
    return (*MODELS, *(_body_card(name) for name in _generators()))


def model_of(name: str) -> ModelCard:
    """The card of that name.

    Raises:
        InputRejected: there is none.
    """
    found = {card.name: card for card in every_model()}
    if name not in found:
        import difflib

        alike = difflib.get_close_matches(name.lower(), found, n=1)
        raise InputRejected(
            f"no model '{name}' is known", "one of " + ", ".join(found),
            f"fluidlift models get {alike[0]}" if alike else "fluidlift models",
        )  # fmt: skip
    return found[name]


def lacking_packages(card: ModelCard) -> list[str]:
    """The packages of a model that are not installed here; of a generator none, as it has an environment of its own."""
    if card.back_end[0] == "generator":
        return []
    missing = []
    for package in card.packages:
        try:
            there = find_spec(package) is not None
        except (ImportError, ValueError):
            there = False
        if not there:
            missing.append(package)
    return missing


def _generators() -> tuple[str, ...]:
    from fluidlift.backends.generators import GENERATORS

    return GENERATORS


def _body_card(name: str) -> ModelCard:
    from fluidlift.backends.generators import card_of

    card = card_of(name)
    terms = _BODY_TERMS.get(name, "allowed" if card.licence_commercial else "research")
    return ModelCard(
        name, card.title, ("bodies",), ("generator", name), card.licence, terms, card.home, packages=card.packages,
        cpu="a GPU is needed" if card.needs_gpu else "not measured",
        notes=(f"It fetches its weights into an environment of its own: fluidlift generators {name}",),
    )  # fmt: skip
