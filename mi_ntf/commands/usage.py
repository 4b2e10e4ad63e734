"""Sentences for command lines that tyro refuses, in place of its boxes."""

import difflib
import re

_COLOUR = re.compile(r"\x1b\[[\d;]*m")
_RULE = re.compile(r"^[─-]{3,}$")
_NAMES = re.compile(r"^ {4}(?=\S)(.*)$")
"""Line of a box that names an argument; its description is indented further."""


def sentence(command: str, words: list[str], box: str, described: str) -> str:
    """Return what is wrong with the `words` after `command`, and what is legal.

    `box` is tyro's text of the error. It may name an argument that an unknown option took the place of, so options are
    looked up in `described`, the command's help, first.
    """
    fault = _unknown(command, words, described) or _fault(command, words, box)
    return fault if fault.endswith("?") else f"{fault.rstrip('.')}; `mi-ntf {command} -h` describes the options"


def _unknown(command: str, words: list[str], described: str) -> str:
    """Return the sentence for the first of the words that is no option of the command; "" if all are."""
    known = re.findall(r"--?[a-zA-Z][\w-]*", " ".join(re.findall(r"^  (-.*)", described, re.M)))
    for word in words:
        option = word.partition("=")[0].replace("_", "-")
        if re.match("--?[a-zA-Z]", word) and option not in known and option[:2] not in known:  # -mVARIANT is one word
            near = difflib.get_close_matches(option, known, 1)
            return f"{command} has no option {word.partition('=')[0]}" + (f"; did you mean {near[0]}?" if near else "")
    return ""


def _fault(command: str, words: list[str], box: str) -> str:
    """Return what is wrong by tyro's text."""
    lines = _COLOUR.sub("", box).splitlines()
    lines = [line[2:].rstrip(" │") for line in (lines[1:-1] if box.count("╭") else lines[2:])]
    end = next((i for i, line in enumerate(lines) if _RULE.match(line)), len(lines))
    text = " ".join(" ".join(lines[:end]).split())
    if text.startswith("Missing from"):
        names = [name[1].split(", ")[0] for line in lines[:end] if (name := _NAMES.match(line))]
        return f"{command} needs {' and '.join(names)}"
    if missing := re.search(r"Missing value for argument '([^']+)'", text):
        return f"{missing[1].split('/')[-1]} needs a value"
    if listed := re.match(r"Unrecognized (?:or misplaced )?options: (.*)", text):
        word = next((w for w in sorted(words, key=len, reverse=True) if w and listed[1].startswith(w)),
                    listed[1].split()[0])
        return f"{command} has no place for {word!r}: it is one argument too many"
    if refused := re.match(r"Error parsing (\S+):", text) or re.search(r" for argument '([^']+)'", text):
        option = refused[1].split("/")[-1]
        legal = _legal(text)
        return f"{option} is {_value(words, option)!r}, must be {legal}" if legal else text
    return text


def _legal(text: str) -> str:
    """Return what an option may be, by the text of an error of its value; "" if that does not say it."""
    if choices := re.search(r"Expected one of \(([^)]*)\)", text):
        return _listed(choices[1])
    if choices := re.search(r"does not match choices \((?!'None',\))([^)]*)\)", text):
        return _listed(choices[1])
    return "a number" if "to float" in text else "a whole number" if "int()" in text else ""


def _listed(choices: str) -> str:
    names = sorted(name for name in re.findall(r"'([^']*)'", choices) if name != "None")  # tyro's order varies
    return " or ".join(filter(None, [", ".join(names[:-1]), *names[-1:]]))


def _value(words: list[str], option: str) -> str:
    """Return the value of an option in a command line."""
    for word, after in zip(words, [*words[1:], ""], strict=True):
        name, equals, value = word.partition("=")
        if name.replace("_", "-") == option:
            return value if equals else after
    return ""
