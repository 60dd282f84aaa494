"""What stage controllers say: every vector whole, byte by byte and with noise around; nothing else is understood."""

import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.protocols import grbl, marlin, tmcl, zaber
from drivers.protocols.outbox import Outbox
from drivers.protocols.text_lines import TextLines
from simulators.devices.grbl import GrblDevice
from simulators.devices.marlin import MarlinDevice
from simulators.devices.zaber import ZaberDevice
from tests.vectors.stages import GRBL, GRBL_JOG, MARLIN, MARLIN_LINES, TMCL, ZABER, ZABER_COMMANDS

SHARED = Path(__file__).resolve().parents[4] / "shared" / "protocols" / "vectors.json"
PARSERS = {"grbl": grbl.parse, "marlin": marlin.parse, "zaber": zaber.parse}
VECTORS = [
    pytest.param(name, data, said, id=f"{name}: {title}")
    for name, vectors in (("grbl", GRBL), ("marlin", MARLIN), ("zaber", ZABER))
    for title, (data, said) in vectors.items()
]
NOISE = [b"", b"\xff\x00\x81", b"\r\n\r\n", b"ok?\x07\n", bytes(range(128, 256)) * 5]


def shared_vectors(*protocols: str) -> list[dict[str, Any]]:
    if not SHARED.exists():
        pytest.skip("the shared vectors are not beside this checkout")
    return [item for item in json.loads(SHARED.read_text())["vectors"] if item["protocol"] in protocols]


def said_in(name: str, data: bytes, piece: int) -> list[object]:
    lines = TextLines()
    return [PARSERS[name](line) for at in range(0, len(data), piece) for line in lines.receive(data[at : at + piece])]


@pytest.mark.parametrize(("name", "data", "said"), VECTORS)
@pytest.mark.parametrize("noise", NOISE)
def test_every_vector_is_read_whole_and_byte_by_byte_with_noise_around(
    name: str, data: bytes, said: list[object], noise: bytes
) -> None:
    if noise and not noise.endswith(b"\n"):
        noise += b"\n"  # noise that runs into a line damages it; that is another law
    stream = noise + data + noise + data
    for piece in (len(stream), 1, 3):
        assert [item for item in said_in(name, stream, piece) if item in said] == said + said


def test_commands_are_written_as_the_vectors_say() -> None:
    assert grbl.jog(*GRBL_JOG[1]) == GRBL_JOG[0]
    for line, (number, command) in MARLIN_LINES.items():
        assert marlin.numbered(number, command) == line
    for line, (device, axis, words, message_id) in ZABER_COMMANDS.items():
        assert zaber.command(device, axis, words, message_id) == line
    with pytest.raises(ValueError, match="80 characters"):
        grbl.jog("X", 1e70, 600.0)
    with pytest.raises(ValueError, match="id 100"):
        zaber.command(1, 1, "get pos", 100)


@pytest.mark.parametrize("title", TMCL)
@pytest.mark.parametrize("noise", [b"", b"\x01", b"\xff" * 8, b"\x01\x06\x01"])
def test_telegrams_are_written_and_read_whole_byte_by_byte_and_after_noise(title: str, noise: bytes) -> None:
    data, telegram = TMCL[title]
    assert telegram.data == data
    for piece in (64, 1):
        reader = tmcl.Telegrams()
        found: list[tmcl.Telegram] = []
        for part in (noise, data, data):
            for at in range(0, len(part), piece):
                found += reader.receive(part[at : at + piece])
            reader.silence() if part is noise else None
        assert found == [telegram, telegram]
        assert reader.skipped_bytes + 18 + reader.waiting_bytes == len(noise) + 18


def test_a_telegram_with_any_one_byte_changed_is_refused() -> None:
    for data, _ in TMCL.values():
        for at in range(9):
            for change in range(1, 256):
                assert tmcl.parse(data[:at] + bytes([data[at] ^ change]) + data[at + 1 :]) is None


# ---- the shared vectors ------------------------------------------------------------------------------------------


def test_every_shared_grbl_vector_is_understood_in_any_pieces_and_with_noise() -> None:
    for vector in shared_vectors("grbl11"):
        reply = bytes.fromhex(vector["reply"]["hex"])
        for noise in (b"", b"\xfe\xc0\r\n"):
            stream = noise + reply + noise
            whole, single = said_in("grbl", stream, len(stream)), said_in("grbl", stream, 1)
            assert whole == single
            assert whole
            assert not any(isinstance(item, grbl.Other) for item in whole), vector["name"]


def test_the_simulated_grbl_answers_the_shared_requests_as_the_real_one_did() -> None:
    answered = 0
    for vector in shared_vectors("grbl11"):
        if "grblHAL" in vector["name"] or "status" in vector["name"]:
            continue  # another firmware, or pins and buffers that this one does not have
        device = GrblDevice({22: 0})
        device.transmit(0.0, 9999)
        device.receive(bytes.fromhex(vector["request"]["hex"]), 0.0)
        assert device.transmit(0.0, 9999) == bytes.fromhex(vector["reply"]["hex"]), vector["name"]
        answered += 1
    assert answered >= 5


def test_every_shared_marlin_vector_is_understood_and_its_checksums_are_right() -> None:
    for vector in shared_vectors("marlin"):
        request, reply = bytes.fromhex(vector["request"]["hex"]), bytes.fromhex(vector["reply"]["hex"])
        said = said_in("marlin", reply, 1)
        assert isinstance(said[-1], marlin.Done)
        if vector["name"] == "M114":
            assert isinstance(said[0], marlin.Position)
            assert (said[0].planned["Y"], said[0].counts["Y"]) == (127.0, 10160)
        body, star, total = request.decode().strip().rpartition("*")
        if star:
            assert marlin.checksum(body) == int(total)
        device = MarlinDevice()
        device.transmit(0.0, 9999)
        device.receive(request, 0.0)
        answer = said_in("marlin", device.transmit(1.0, 9999), 1)
        assert answer[-1] == marlin.Done()
        assert not any(isinstance(item, marlin.Resend) for item in answer)


def test_every_shared_zaber_vector_is_understood_and_written() -> None:
    for vector in shared_vectors("zaber_ascii"):
        request = bytes.fromhex(vector["request"]["hex"])
        if vector["reply"] is None:
            assert zaber.command(1, 0, "get pos", 0) == request
            continue
        reply = bytes.fromhex(vector["reply"]["hex"])
        assert said_in("zaber", reply, 1) == [zaber.Reply(1, 0, -1, True, False, "--", "0")]
        device = ZaberDevice(has_reference=True)
        device.receive(request, 0.0)
        answer = device.transmit(0.0, 9999)
        assert answer[:14] == reply[:14]


def test_every_shared_tmcl_vector_is_read_and_written() -> None:
    vectors = shared_vectors("trinamic_tmcl")
    assert len(vectors) >= 6
    for vector in vectors:
        for part in (vector["request"], vector["reply"]):
            if part is None:
                continue
            data = bytes.fromhex(part["hex"])
            for piece in (9, 1):
                reader = tmcl.Telegrams()
                found = [item for at in range(0, 9, piece) for item in reader.receive(data[at : at + piece])]
                assert [item.data for item in found] == [data]


# ---- laws --------------------------------------------------------------------------------------------------------


@given(st.lists(st.binary(max_size=80), max_size=20), st.integers(1, 7))
def test_no_byte_of_text_is_unaccounted_for_and_pieces_do_not_matter(parts: list[bytes], piece: int) -> None:
    stream = b"".join(parts)
    whole, cut = TextLines(64), TextLines(64)
    lines = whole.receive(stream)
    assert [line for at in range(0, len(stream), piece) for line in cut.receive(stream[at : at + piece])] == lines
    for reader in (whole, cut):
        counts = reader.counts
        assert counts.received == counts.in_lines + counts.damaged + counts.ends + reader.waiting_bytes
        assert reader.waiting_bytes <= 64
    assert whole.counts == cut.counts


@given(st.text(alphabet=st.characters(min_codepoint=32, max_codepoint=126), max_size=120))
def test_any_line_is_parsed_to_something(line: str) -> None:
    for parse in PARSERS.values():
        assert parse(line) is not None


@given(st.data())
def test_a_changed_character_of_a_checked_zaber_reply_is_never_accepted(data: Any) -> None:
    text = "@01 1 07 OK BUSY WR 1234:F7"
    at = data.draw(st.integers(1, len(text) - 4))
    new = data.draw(st.characters(min_codepoint=33, max_codepoint=126))
    changed = text[:at] + new + text[at + 1 :]
    said = zaber.parse(changed, needs_checksum=True)
    assert changed == text or isinstance(said, zaber.Damaged)


@given(st.lists(st.integers(1, 127), max_size=40), st.data())
def test_never_more_characters_are_out_than_the_controller_holds(lengths: list[int], data: Any) -> None:
    count, out, waiting = grbl.CharacterCount(), [], [b"x" * (length - 1) + b"\n" for length in lengths]
    while waiting or out:
        if waiting and count.has_room(waiting[0]) and data.draw(st.booleans() if out else st.just(True)):
            out.append(waiting.pop(0))
            count.sent(out[-1])
        else:
            assert count.acknowledged()
            out.pop(0)
        assert count.used == sum(map(len, out)) <= 127
        assert count.lines == len(out)
    assert not count.acknowledged()


@given(st.lists(st.binary(min_size=1, max_size=9), min_size=1, max_size=8), st.integers(0, 80), st.booleans())
def test_what_overtakes_goes_before_everything_not_begun_and_breaks_no_message_in_two(
    messages: list[bytes], written: int, inside: bool
) -> None:
    outbox = Outbox()
    for message in messages:
        outbox.put(message)
    written = min(written, len(outbox))
    sent = outbox.peek()[:written]
    outbox.wrote(written)
    begun, edge = 0, 0
    while edge < written:
        edge += len(messages[begun])
        begun += 1
    rest = b"".join(messages[:begun])[written:]
    dropped = outbox.overtake(b"STOP", inside_messages=inside)
    assert dropped == messages[begun:]
    assert outbox.peek() == (b"STOP" + rest if inside else rest + b"STOP")
    assert len(outbox) == len(rest) + 4
    assert sent + rest == b"".join(messages[:begun])


def test_marlin_lines_can_be_sent_again_as_long_as_they_are_kept() -> None:
    sent = marlin.SentLines(depth=3)
    assert sent.reset() == b"N0 M110 N0*125\n"
    lines = [sent.add(f"G1 X{n}") for n in range(1, 6)]
    assert sent.again(3) == lines[2:]
    assert sent.again(6) == []
    assert sent.again(2) is None
    assert sent.again(7) is None
    sent.reset()
    assert sent.again(3) is None
