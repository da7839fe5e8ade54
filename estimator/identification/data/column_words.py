"""Words in the names of columns, in several languages: which column is the time, the input or the output."""

from __future__ import annotations

import re
import unicodedata

#: Role of a column to the words that state it, by language (ISO 639-1; ``any``: symbols).
WORDS_OF_ROLE = {
    "time": {
        "any": ("t",),
        "en": ("time", "timestamp", "datetime", "seconds", "sec", "msec"),
        "de": ("zeit", "sekunden"),
        "fr": ("temps", "secondes"),
        "es": ("tiempo", "segundos"),
        "it": ("tempo", "secondi"),
        "nl": ("tijd",),
    },
    "input": {
        "any": ("u",),
        "en": ("input", "in", "drive", "excitation", "exciter", "stimulus"),
        "de": ("eingang", "eingabe", "anregung", "erregung"),
        "fr": ("entrée",),
        "es": ("entrada", "excitación"),
        "it": ("ingresso", "eccitazione"),
        "nl": ("ingang", "excitatie"),
    },
    "output": {
        "any": ("y",),
        "en": ("output", "out", "response"),
        "de": ("ausgang", "ausgabe", "antwort"),
        "fr": ("sortie", "réponse"),
        "es": ("salida", "respuesta"),
        "it": ("uscita", "risposta"),
        "nl": ("uitgang", "respons"),
    },
}

#: Quantity of a column to the words that name it, by language. Voltage and current are in none: either may be.
WORDS_OF_QUANTITY = {
    "force": {
        "any": ("f",),
        "en": ("force", "torque"),
        "de": ("kraft", "drehmoment"),
        "es": ("fuerza",),
        "it": ("forza",),
        "pt": ("força",),
        "nl": ("kracht",),
    },
    "displacement": {
        "any": ("x",),
        "en": ("displacement", "disp", "position", "pos", "deflection"),
        "de": ("weg", "auslenkung", "verschiebung"),
        "fr": ("déplacement",),
        "es": ("desplazamiento", "posición"),
        "it": ("spostamento", "posizione"),
        "pt": ("deslocamento", "posição"),
        "nl": ("verplaatsing", "uitwijking", "positie"),
    },
    "velocity": {
        "any": ("v",),
        "en": ("velocity", "vel", "speed"),
        "de": ("geschwindigkeit", "schnelle"),
        "fr": ("vitesse",),
        "es": ("velocidad",),
        "it": ("velocità",),
        "pt": ("velocidade",),
        "nl": ("snelheid",),
    },
    "acceleration": {
        "any": ("a",),
        "en": ("acceleration", "accel", "acc"),
        "de": ("beschleunigung",),
        "fr": ("accélération",),
        "es": ("aceleración",),
        "it": ("accelerazione",),
        "pt": ("aceleração",),
        "nl": ("versnelling",),
    },
}

#: Symbols of a quantity that state the role alone: x may be the displacement, or any output.
_SYMBOLS_OF_NO_KIND = ("x",)

#: Letters of a word that counts in every place of a name, at least; a shorter one counts as the first word alone.
_MIN_LETTERS = 3

#: Letters of a word that counts also as the beginning or the end of a longer one, at least, as in Anregungskraft.
_MIN_LETTERS_OF_PART = 5


def _without_accents(text: str) -> str:
    return "".join(c for c in unicodedata.normalize("NFKD", text.casefold()) if not unicodedata.combining(c))


def _meanings(table: dict[str, dict[str, tuple[str, ...]]]) -> dict[str, str]:
    """Word, without accents, to its meaning."""
    return {
        _without_accents(word): meaning
        for meaning, languages in table.items()
        for words in languages.values()
        for word in words
    }


_ROLE_OF_WORD, _QUANTITY_OF_WORD = _meanings(WORDS_OF_ROLE), _meanings(WORDS_OF_QUANTITY)


def first_word(name: str) -> str:
    """The first word of a column's name, in lower case and without accents."""
    words = _words(name)
    return words[0] if words else ""


def _words(name: str) -> list[str]:
    """The words of a name, in lower case and without accents."""
    return re.findall(r"[^\W\d_]+", _without_accents(name))


def _meanings_in_name(name: str, meaning_of_word: dict[str, str]) -> list[str]:
    """The meanings of the words of a name, in their order."""
    found = []
    for place, word in enumerate(_words(name)):
        if word in meaning_of_word and (place == 0 or len(word) >= _MIN_LETTERS):
            found.append(meaning_of_word[word])
            continue
        parts = [known for known in meaning_of_word if len(known) >= _MIN_LETTERS_OF_PART and known in word]
        # The last part of a compound is its head.
        heads = [known for known in parts if word.endswith(known)] or [k for k in parts if word.startswith(k)]
        found += [meaning_of_word[max(heads, key=len)]] if heads else []
    return found


def role_in_name(name: str) -> str | None:
    """The role that the name of a column states: ``time``, ``input`` or ``output``; None where it states none.

    A word for a role, such as input, decides before a word for a quantity. Quantities of both roles decide nothing.

    Example:
        >>> [role_in_name(name) for name in ("shaker force [N]", "Weg (mm)", "input acc", "force at position 2", "CH1")]
        ['input', 'output', 'input', None, None]
        >>> [role_in_name(name) for name in ("Anregungskraft", "accélération", "Zeit", "Channel A")]
        ['input', 'output', 'time', None]
    """
    if _ROLE_OF_WORD.get(first_word(name)) == "time":
        return "time"
    roles = [role for role in _meanings_in_name(name, _ROLE_OF_WORD) if role != "time"]
    if roles:
        return roles[0]
    quantities = {"input" if one == "force" else "output" for one in _meanings_in_name(name, _QUANTITY_OF_WORD)}
    return quantities.pop() if len(quantities) == 1 else None


def sensor_kind_in_name(name: str, min_letters: int = 1) -> str | None:
    """The kind of output that the name of a column states; None where it states none, or several.

    Args:
        name: name of the column.
        min_letters: letters of its first word, at least: a symbol such as v may stand for another quantity.

    Example:
        >>> [sensor_kind_in_name(name) for name in ("v [m/s]", "Beschleunigung", "response", "velocity at position 2")]
        ['velocity', 'acceleration', None, None]
    """
    if len(first_word(name)) < min_letters or first_word(name) in _SYMBOLS_OF_NO_KIND:
        return None
    kinds = set(_meanings_in_name(name, _QUANTITY_OF_WORD)) - {"force"}
    return kinds.pop() if len(kinds) == 1 else None
