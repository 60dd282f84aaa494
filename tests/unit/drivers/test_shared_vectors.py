"""Bytes as manufacturers printed them and as real devices were heard, where that collection lies beside the checkout.

It is not part of the project: without it these tests are skipped, and the hand-made vectors stand alone.
"""

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from drivers.protocols.framing import Damage
from drivers.protocols.lms import Telegram, TelegramDecoder, read_values, telegram
from drivers.protocols.ls100 import Frame, FrameDecoder, frame, read_header, read_points, read_request
from drivers.protocols.rplidar import AnswerDecoder, Descriptor, RequestDecoder, request
from drivers.protocols.scip import Reply, ReplyDecoder, decode_values, encode_value, info_fields, stream_echo
from simulators.devices.scip import ScipDevice
from tests.unit.drivers.conversation_bench import flat_scene

COLLECTION = Path(__file__).resolve().parents[4] / "shared" / "protocols" / "vectors.json"
VECTORS = json.loads(COLLECTION.read_text(encoding="utf-8"))["vectors"] if COLLECTION.exists() else []
SCANNERS = ("scip2", "sick_lms2xx", "rplidar", "sick_profiler2 / optex_fastus_ls")
OURS = [vector for vector in VECTORS if vector["protocol"] in SCANNERS]
NOISE = [b"", b"\x55" * 11, b"\x00\xff\x7f", b"AT+CGMM\r\n"]

pytestmark = pytest.mark.skipif(not VECTORS, reason=f"{COLLECTION} is not there")


def bytes_of(part: dict | None) -> bytes | None:
    return None if part is None else bytes.fromhex(part["hex"])


def named(protocol: str, text: str) -> dict:
    [vector] = [v for v in OURS if v["protocol"] == protocol and text in v["name"]]
    return vector


def pairs(protocol: str, part: str) -> list:
    return [
        pytest.param(v, bytes_of(v[part]), id=f"{part}: {v['name']}")
        for v in OURS
        if v["protocol"] == protocol and v.get(part) is not None
    ]


def read_both_ways(make: Callable, before: bytes, data: bytes, kinds: tuple, after: bytes = b"") -> list:
    """The intact items in `data` with noise around, the same whatever the pieces it comes in."""
    whole, single = make(), make()
    stream = before + data + after
    found = whole.receive(stream)
    assert [item for at in range(len(stream)) for item in single.receive(stream[at : at + 1])] == found
    return [item for item in found if isinstance(item, kinds)]


def test_the_collection_holds_what_these_tests_were_written_for() -> None:
    counts = {protocol: sum(v["protocol"] == protocol for v in OURS) for protocol in SCANNERS}
    assert counts == {
        "scip2": 14,
        "sick_lms2xx": 21,
        "rplidar": 15,
        "sick_profiler2 / optex_fastus_ls": 14,
    }


# ---- SCIP 2.0 -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("vector", "data"), pairs("scip2", "reply"))
@pytest.mark.parametrize("noise", [*(n for n in NOISE if not n), b"\n", b"\x55\x55\n\n"])
def test_scip_replies(vector: dict, data: bytes, noise: bytes) -> None:
    if data.endswith(b"99b\n"):  # only the head of a scan
        data += b"\n"
    found = read_both_ways(ReplyDecoder, noise, data, (Reply,))
    echoes = re.findall(r"[A-Z]{2}\d*", vector["request"]["ascii"])
    assert found[0].echo == echoes[0]
    decoded = vector["decoded"]
    if "status" in decoded:
        assert found[0].status == decoded["status"]
    elif "first" in decoded:
        assert [item.status for item in found] == ["00", "99"]
        assert stream_echo(found[1].echo).remaining == 2
    else:
        fields, wrong = info_fields(found[0].lines)
        assert wrong == 0
        assert all(fields[key] == str(value) for key, value in decoded.items())


def test_scip_encodings() -> None:
    vectors = [v for v in OURS if v["protocol"] == "scip2" and "encoded" in v]
    assert len(vectors) == 3
    for vector in vectors:
        text = vector["encoded"].encode()
        assert encode_value(vector["value"], len(text)) == text
        assert decode_values(text, len(text)).tolist() == [vector["value"]]


@pytest.mark.parametrize("name", ["first bytes urg_c", "commands hokuyolx"])
def test_what_published_scip_clients_say_is_understood_by_the_simulator(name: str) -> None:
    device = ScipDevice(flat_scene())
    said = bytes_of(named("scip2", name)["request"])
    answers = []
    for command in said.splitlines():
        device.receive(command + b"\n", 1.0)
        answers += ReplyDecoder().receive(device.transmit(1.0, 100_000))
    assert len(answers) >= len(said.splitlines())
    assert all(isinstance(item, Reply) and item.status in ("00", "02") for item in answers)


# ---- SICK LMS2xx ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("vector", "data"), [*pairs("sick_lms2xx", "request"), *pairs("sick_lms2xx", "reply")])
@pytest.mark.parametrize("noise", NOISE)
def test_lms_telegrams(vector: dict, data: bytes, noise: bytes) -> None:
    is_reply = data[1] >= 0x80
    make = TelegramDecoder if is_reply else (lambda: TelegramDecoder(from_host=True))
    found = read_both_ways(make, noise, data, (Telegram,), b"\x55" * 900)
    if vector["name"].startswith("ERRATUM"):
        assert found == []
        return
    assert [item.n_bytes for item in found] == [len(data)]
    content = found[0].data + (b"" if found[0].status is None else bytes([found[0].status]))
    assert telegram(found[0].address, found[0].command, content) == data
    decoded = vector.get("decoded", {})
    if is_reply and "response" in decoded:
        assert found[0].command == decoded["response"]
    if is_reply and "type" in decoded:
        assert found[0].data.decode() == decoded["type"]


# ---- RPLIDAR --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("vector", "data"), pairs("rplidar", "reply"))
@pytest.mark.parametrize("noise", NOISE)
def test_rplidar_descriptors(vector: dict, data: bytes, noise: bytes) -> None:
    found = read_both_ways(AnswerDecoder, noise, data, (Descriptor,))
    decoded = vector["decoded"]
    assert [(item.kind, item.length) for item in found] == [(decoded["type"], decoded["length"])]
    if "mode" in decoded:
        assert found[0].many == (decoded["mode"] == "multiple")


@pytest.mark.parametrize(("vector", "data"), pairs("rplidar", "request"))
@pytest.mark.parametrize("noise", NOISE)
def test_rplidar_requests(vector: dict, data: bytes, noise: bytes) -> None:
    [(command, payload)] = read_both_ways(RequestDecoder, noise, data, (tuple,))
    assert request(command, payload) == data
    if "pwm" in vector.get("decoded", {}):
        assert int.from_bytes(payload, "little") == vector["decoded"]["pwm"]
    if "conf" in vector.get("decoded", {}):
        assert payload[0] == vector["decoded"]["conf"]


# ---- SICK Profiler 2, Optex LS-100 ----------------------------------------------------------------------------------

PROFILER = "sick_profiler2 / optex_fastus_ls"


@pytest.mark.parametrize(("vector", "data"), [*pairs(PROFILER, "request"), *pairs(PROFILER, "reply")])
@pytest.mark.parametrize("noise", NOISE)
def test_profiler_frames(vector: dict, data: bytes, noise: bytes) -> None:
    found = read_both_ways(FrameDecoder, noise, data, (Frame,), b"\x55" * 600)
    if vector["name"].startswith("ERRATUM"):
        assert found == []
        return
    assert [item.whole for item in found] == [data]
    assert frame(found[0].command, found[0].data) == data


def test_profiler_values() -> None:
    [size] = FrameDecoder().receive(bytes_of(named(PROFILER, "profile size")["reply"]))
    assert read_header(size.data, has_time=None) == (832, None)
    [value] = FrameDecoder().receive(bytes_of(named(PROFILER, "measured value")["reply"]))
    assert int.from_bytes(value.data, "big") == 23138
    assert read_request(0x03062004, 126, 2) == bytes_of(named(PROFILER, "126 points from")["request"])
    assert read_request(0x03062004, 126, 2, 2) == bytes_of(named(PROFILER, "every second")["request"])
    begins = bytes.fromhex("03 06 20 04 CC F9 10 35 CD 1D 00 00")
    x_mm, z_mm, _ = read_points(begins, 2)
    assert (x_mm[0], z_mm[0], x_mm[1]) == (-13.063, 4.149, -13.027)


@pytest.mark.parametrize(("vector", "data"), pairs("sick_lms2xx", "reply")[:1])
def test_damage_is_never_silent(vector: dict, data: bytes) -> None:
    wrong = data[:-1] + bytes([data[-1] ^ 0xFF])
    assert any(isinstance(item, Damage) for item in TelegramDecoder().receive(wrong + data))
    with pytest.raises(ValueError, match="do not hold"):
        read_values(b"\x05\x00\x01\x00")
