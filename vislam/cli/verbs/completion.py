"""`vislam completion SHELL`: what makes the shell complete verbs, options and their words."""

from dataclasses import dataclass
from importlib import import_module
from typing import Literal

from tyro.conf import Positional

from vislam.cli.verbs import VERBS
from vislam.cli.verbs.arguments import parse
from vislam.cli.verbs.brief import choices_of, flags_of
from vislam.config.ranges import settings_of


@dataclass(frozen=True)
class CompletionOptions:
    """Options of `vislam completion`."""

    shell: Positional[Literal["bash", "zsh"]]
    """Prints a script for it: `vislam completion bash >> ~/.bashrc` (zsh: >> ~/.zshrc) installs it"""


OPTIONS = (CompletionOptions,)

_SCRIPT = """\
_vislam() {{
    local word="${{COMP_WORDS[COMP_CWORD]}}" before="${{COMP_WORDS[COMP_CWORD-1]}}"
    local verb="${{COMP_WORDS[1]}}" words=""
    if [ "$COMP_CWORD" -eq 1 ]; then
        COMPREPLY=($(compgen -W "{verbs}" -- "$word")); return
    fi
    case "$verb $before" in
{choices}
    esac
    if [ -z "$words" ]; then case "$word" in -*) case "$verb" in
{options}
    esac;; *) case "$verb" in
{others}
    esac;; esac; fi
    COMPREPLY=($(compgen -W "$words" -- "$word"))
}}
complete -o default -F _vislam vislam
"""


def main(arguments: list[str]) -> int:
    """Print the script for a shell."""
    options = parse(CompletionOptions, arguments, "completion")
    start = "autoload -U +X bashcompinit && bashcompinit\n" if options.shell == "zsh" else ""
    print(start + script(), end="")
    return 0


def script() -> str:
    """Return the script for bash: every verb with its options, and the words that they know."""
    choices, options, others = [], [], []
    for verb in VERBS:
        flags, words = known_options(verb)
        options.append(f"    {verb}) words='{' '.join(flags)}';;")
        choices += [f"    '{verb} {flag}') words='{' '.join(known)}';;" for flag, known in flags.items() if known]
        if words:
            others.append(f"    {verb}) words='{' '.join(words)}';;")
    lines = ("\n".join(part) for part in (choices, options, others))
    return _SCRIPT.format(verbs=" ".join(VERBS), **dict(zip(("choices", "options", "others"), lines, strict=True)))


def known_options(verb: str) -> tuple[dict[str, tuple[str, ...]], tuple[str, ...]]:
    """Return the options of a verb, each with the words that it knows, and the words it takes without an option."""
    module = import_module(f"vislam.cli.verbs.{verb}")
    flags: dict[str, tuple[str, ...]] = dict.fromkeys(("--help", "--help-all", "--log-level"), ())
    flags |= {name.split()[0]: () for name in getattr(module, "TAKEN", {})}
    words = tuple(getattr(module, "WORDS", ()))
    for options in module.OPTIONS:
        for setting in settings_of(options):
            names = flags_of(setting)
            flags |= dict.fromkeys(names, choices_of(setting.type))
            words += () if names else choices_of(setting.type)
    return flags, words
