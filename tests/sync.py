"""Copy what both scripts share from ppo.py into ppo_rgb.py: the imports with the stand-in for a missing renderer, and
everything below the banner.

    python tests/sync.py
"""

from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
FIRST_IMPORT, FLAGS, BANNER = "import contextlib\n", "# ----- Flags -", "# ----- Machinery: nothing below is PPO -"


def shared_parts(text: str) -> tuple[str, str]:
    """The imports of a script, and its machinery."""
    for line in (FIRST_IMPORT, FLAGS, BANNER):
        assert text.count(line) == 1, f"{line!r} must be there once"
    return text[text.index(FIRST_IMPORT) : text.index(FLAGS)], text[text.index(BANNER) :]


if __name__ == "__main__":
    state, images = [ROOT / name for name in ("ppo.py", "ppo_rgb.py")]
    text = images.read_text()
    for new, old in zip(shared_parts(state.read_text()), shared_parts(text)):
        text = text.replace(old, new)
    images.write_text(text)
