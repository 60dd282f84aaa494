"""Names of regions in pictures and reports; knows no picture, since the library that draws is imported to draw."""


def letters_of(number: int) -> str:
    """A, B, … Z, AA, AB, … for 1, 2, …; the number as it is below 1."""
    letters = ""
    while number > 0:
        number, last = divmod(number - 1, 26)
        letters = chr(ord("A") + last) + letters
    return letters or str(number)
