"""Texts for a post: escaped, so that nothing in them is Markdown, HTML, a mention or a link on any site; and without private data."""

from __future__ import annotations

import re

from rotorwatch.base.files import one_line

APART = "\u200b"  # zero width: it breaks mentions, links and emoji
HIDDEN = "…"
LONGEST = 4_000  # letters of a text that are processed
# Commands and options of rotorwatch in its own sentences. Of these letters nothing can be made but code.
COMMAND = re.compile(r"(`rotorwatch [\w .-]+`|(?<![\w-])--[a-z]+(?:-[a-z]+)*(?: [A-Z]+(?:\.[A-Z]+)?)?(?![\w-]))")
SIGNS = re.compile(r"[\\`*_\[\]|~^$<>&]")
NAMED = {"<": "&lt;", ">": "&gt;", "&": "&amp;", "$": "&#36;"}
# Before the place where APART goes: mentions, issues, addresses and names of hosts, Reddit's users and rooms, emoji.
LIVE = re.compile(
    r"@(?=\w)|\#(?=\w)|\bww(?=w\.)|\bGH-(?=\d)|:(?=//)|(?<=\w)\.(?=[^\W\d])|\b[ru]/(?=\w)|\b(?:mailto|xmpp):(?=\w)"
    r"|:(?=[\w+-]*[A-Za-z+_-][\w+-]*:)|:(?=100:|1234:)",
    re.IGNORECASE,
)
START = re.compile(r"^(?:([-+=#])|(\d+)([.)])(?=\s|$))")
HEX = r"[0-9A-Fa-f]"
PRIVATE = tuple(
    (re.compile(pattern, re.IGNORECASE), put)
    for pattern, put in (
        (r"\b[a-z][a-z0-9+.-]*://\S+", HIDDEN),  # addresses
        (r"[\w.+-]+@[\w-]+(?:\.[\w-]+)+", HIDDEN),
        # folders; the file's own name stays
        (r"(?<![\w./\\])(?:[A-Za-z]:|~)?[\\/]+(?:[^\\/\s]*[\\/])*(?=[^\\/\s])", ""),
        # addresses of networks, UUIDs, serial numbers of processors
        (rf"(?<![0-9A-Za-z]){HEX}{{2}}(?:[:-]{HEX}{{2}}){{5,}}(?![0-9A-Za-z])", HIDDEN),
        (rf"(?<![0-9A-Za-z]){HEX}{{8}}-(?:{HEX}{{4}}-){{3}}{HEX}{{12}}(?![0-9A-Za-z])", HIDDEN),
        (rf"(?<![0-9A-Za-z]){HEX}{{8}}(?:[ _-]{HEX}{{8}})+(?![0-9A-Za-z])", HIDDEN),
        (rf"(?<![0-9A-Za-z])(?=\w*\d){HEX}{{12,}}(?![0-9A-Za-z])", HIDDEN),
        (r"\b((?:serial|s/n|sn|uid|uuid|unique id)(?: ?(?:number|no\.?))?\s*[:=#]?\s*)(?=\w*\d)[\w-]{4,}", rf"\g<1>{HIDDEN}"),
        (r"\b((?:lat|lon|lng|latitude|longitude)\s*[:=]?\s*)[-+]?\d[\d.]*", rf"\g<1>{HIDDEN}"),
        # latitudes; no number of rotorwatch's own sentences has so many digits
        (r"[-+]?(?<![\d.])\d{1,3}\.\d{4,}", HIDDEN),
        (r"[-+]?\b\d{1,3}°\s*\d[\d.]*(?:['′]\s*[\d.]*(?:[\"″])?)?\s*[NSEW]?\b", HIDDEN),
    )
)
# Of texts of the autopilot also whole numbers as long as latitudes in 1e-7 degrees and as serial numbers, and coarse positions.
LOGGED = re.compile(r"[-+]?(?<!\w)\d{7,}(?!\w)|[-+]?\d{1,3}\.\d+ ?[NSEW]\b|[-+]?\d{1,3}\.\d{2,}\s*[,;/ ]\s*[-+]?\d{1,3}\.\d{2,}")


def escaped(text: object, most: int = 600) -> str:
    """The text as one inert line of Markdown, in CommonMark, on GitHub, Discourse and Reddit, also in a table's cell.

    most: letters of it, before escaping (40 or more).
    """
    parts = COMMAND.split(one_line(str(text), most))
    out = "".join(f"`{part.strip('`')}`" if k % 2 else _inert(part) for k, part in enumerate(parts))
    return START.sub(lambda found: f"\\{found[1]}" if found[1] else f"{found[2]}\\{found[3]}", out)


def _inert(text: str) -> str:
    apart = LIVE.sub(lambda found: found[0] + APART, text)
    return SIGNS.sub(lambda found: NAMED.get(found[0], f"\\{found[0]}"), apart)


def code(text: object, most: int = 160) -> str:
    """Text of others as code, which no site interprets; a backtick and a bar become look-alikes."""
    plain = one_line(str(text), most).replace("`", "ˋ").replace("|", "¦").strip()
    return f"`{plain}`" if plain else ""


def private(text: object, aircraft: str = "", logged: bool = False) -> str:
    """The text without addresses, folders, serial numbers and positions. aircraft: identification of the aircraft, removed word by word;
    logged: written by the autopilot: long numbers are removed, too."""
    out = str(text)
    if len(out) > LONGEST:
        out = out[:LONGEST].rpartition(" ")[0]  # half a serial number would not be known as one
    for word in re.findall(r"[0-9A-Za-z]{8,}", aircraft):
        spaced = r"[ :_-]?".join(map(re.escape, word))
        out = re.sub(spaced, HIDDEN, out, flags=re.IGNORECASE)
    for pattern, put in PRIVATE:
        out = pattern.sub(put, out)
    return LOGGED.sub(HIDDEN, out) if logged else out
