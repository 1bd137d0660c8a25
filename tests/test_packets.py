"""Protocol 2.0: vectors of the manual, round trips, and a parser that nothing stops."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pantograph.hardware import packets as p
from pantograph.hardware.packets import Packet, PacketError
from pantograph.hardware.virtual.parser import Fault, Parser

# e-manual, Protocol 2.0: every example of the page that states both packets.
MANUAL = [
    (p.ping(1), "FF FF FD 00 01 03 00 01 19 4E"),
    (p.ping(), "FF FF FD 00 FE 03 00 01 31 42"),
    (p.status(1, 0, b"\x06\x04\x26"), "FF FF FD 00 01 07 00 55 00 06 04 26 65 5D"),
    (p.status(2, 0, b"\x06\x04\x26"), "FF FF FD 00 02 07 00 55 00 06 04 26 6F 6D"),
    (p.read(1, 132, 4), "FF FF FD 00 01 07 00 02 84 00 04 00 1D 15"),
    (p.status(1, 0, b"\xa6\0\0\0"), "FF FF FD 00 01 08 00 55 00 A6 00 00 00 8C C0"),
    (p.status(2, 0, b"\x1f\x08\0\0"), "FF FF FD 00 02 08 00 55 00 1F 08 00 00 BA BE"),
    (p.write(1, 116, (512).to_bytes(4, "little")), "FF FF FD 00 01 09 00 03 74 00 00 02 00 00 CA 89"),
    (p.reg_write(1, 104, (200).to_bytes(4, "little")), "FF FF FD 00 01 09 00 04 68 00 C8 00 00 00 AE 8E"),
    (p.action(1), "FF FF FD 00 01 03 00 05 02 CE"),
    (p.status(1), "FF FF FD 00 01 04 00 55 00 A1 0C"),
    (p.factory_reset(1, "id"), "FF FF FD 00 01 04 00 06 01 A1 E6"),
    (p.reboot(1), "FF FF FD 00 01 03 00 08 2F 4E"),
    (p.clear_turns(1), "FF FF FD 00 01 08 00 10 01 44 58 4C 22 B1 DC"),
    (p.sync_read(132, 4, [1, 2]), "FF FF FD 00 FE 09 00 82 84 00 04 00 01 02 CE FA"),
    (
        p.sync_write(116, 4, {1: b"\x96\0\0\0", 2: b"\xaa\0\0\0"}),
        "FF FF FD 00 FE 11 00 83 74 00 04 00 01 96 00 00 00 02 AA 00 00 00 82 87",
    ),
    (
        p.bulk_read([(1, 144, 2), (2, 146, 1)]),
        "FF FF FD 00 FE 0D 00 92 01 90 00 02 00 02 92 00 01 00 1A 05",
    ),
    (p.status(1, 0, b"\x77\0"), "FF FF FD 00 01 06 00 55 00 77 00 C3 69"),
    (p.status(2, 0, b"\x24"), "FF FF FD 00 02 05 00 55 00 24 8B A9"),
]

# Bytes that make headers, stuffing and lengths likely.
awkward = st.sampled_from([0xFF, 0xFF, 0xFD, 0xFD, 0x00, 0x01, 0x03, 0x55, 0xFE, 0x07])
blobs = st.lists(st.one_of(awkward, st.integers(0, 255)), max_size=40).map(bytes)
ids = st.one_of(st.integers(0, 252), st.just(p.BROADCAST))
instructions = st.builds(Packet, ids, st.sampled_from([i for i in p.Instruction if i != 0x55]), blobs)
statuses = st.builds(p.status, st.integers(0, 252), st.integers(0, 255), blobs)
values = st.one_of(instructions, statuses)


def crc_bit_by_bit(data: bytes) -> int:
    """Long division of the message by x^16 + x^15 + x^2 + 1."""
    register = 0
    for bit in "".join(f"{byte:08b}" for byte in data) + "0" * 16:
        register = register << 1 | int(bit)
        if register >> 16:
            register ^= 0x18005
    return register


@pytest.mark.parametrize(("packet", "frame"), MANUAL, ids=[f for _, f in MANUAL])
def test_vectors_of_the_manual(packet, frame):
    assert packet.encode() == bytes.fromhex(frame)
    assert Packet.decode(bytes.fromhex(frame)) == packet


@given(st.binary(max_size=60), st.binary(max_size=20))
def test_crc_is_the_remainder_of_a_division(a, b):
    assert p.crc16(a) == crc_bit_by_bit(a)
    assert p.crc16(b, p.crc16(a)) == p.crc16(a + b)


@given(values, st.booleans())
def test_a_packet_survives_the_wire(packet, lenient):
    frame = packet.encode()
    assert Packet.decode(frame, lenient=lenient) == packet
    assert p.HEADER[:3] not in frame[7:-2].replace(b"\xff\xff\xfd\xfd", b"")
    assert Parser(lenient=lenient).feed(frame) == [packet]


@given(blobs)
def test_stuffing_is_undone(body):
    assert p.unstuff(p.stuff(body)) == body
    assert p.is_stuffed(p.stuff(body))


@given(values, st.data())
def test_any_single_bit_error_is_caught(packet, data):
    frame = bytearray(packet.encode())
    place = data.draw(st.integers(4, len(frame) - 1))
    frame[place] ^= 1 << data.draw(st.integers(0, 7))
    with pytest.raises(PacketError):
        Packet.decode(bytes(frame))


def test_messages_say_what_is_wrong():
    frame = bytearray(p.ping(1).encode())
    with pytest.raises(PacketError, match="header"):
        Packet.decode(b"hello")
    with pytest.raises(PacketError, match="length field says 3, the frame has 4"):
        Packet.decode(bytes(frame) + b"\0")
    frame[-1] ^= 1
    with pytest.raises(PacketError, match=r"CRC is 0x4f19, the bytes give 0x4e19"):
        Packet.decode(bytes(frame))


def test_unstuffed_goal_of_the_official_sdk():
    """A goal of -131073 is FF FF FD FF: the SDK sends it unstuffed, with a CRC that fits."""
    goal = p.write(1, 116, (-131073).to_bytes(4, "little", signed=True))
    raw = goal.encode(stuffed=False)
    assert Parser(lenient=True).feed(raw) == [goal]
    strict = Parser(lenient=False)
    assert not [e for e in strict.feed(raw) if isinstance(e, Packet)]
    assert strict.feed(p.ping(2).encode())[-1] == p.ping(2)


@given(st.lists(st.tuples(st.integers(0, 255), st.integers(0, 252), blobs), min_size=1, max_size=6))
def test_fast_replies_are_one_frame_with_running_crcs(blocks):
    frame = p.fast_reply(blocks)
    lengths = [len(data) for _, _, data in blocks]
    assert len(frame) == 8 + sum(4 + n for n in lengths)
    end = 8
    for n in lengths:
        end += 4 + n
        assert crc_bit_by_bit(frame[: end - 2]) == frame[end - 2] | frame[end - 1] << 8
    (packet,) = (e for e in Parser().feed(frame) if isinstance(e, Packet))
    assert packet.is_fast_reply
    assert p.fast_blocks(frame, lengths) == p.fast_blocks(frame, lengths, whole=True) == blocks


@given(
    st.lists(st.tuples(st.integers(0, 255), st.integers(0, 252), blobs), min_size=1, max_size=6),
    st.integers(0, 10**6),
    st.integers(1, 255),
)
def test_of_a_broken_fast_reply_the_blocks_before_the_break_count(blocks, place, flip):
    """Cut short, or with a byte changed: what comes before is read, what comes after is not believed."""
    frame, lengths = p.fast_reply(blocks), [len(data) for _, _, data in blocks]
    place %= len(frame)
    ends = np.cumsum([4 + n for n in lengths]) + 8
    before = blocks[: int(np.searchsorted(ends, place, "right"))]
    assert p.fast_blocks(frame[:place], lengths) == before
    changed = bytearray(frame)
    changed[place] ^= flip
    assert p.fast_blocks(bytes(changed), lengths) == before


def test_a_fast_reply_that_breaks_off_still_tells_its_whole_length():
    frame = p.fast_reply([(0, 1, b"\1\2")], p.fast_length([2, 2]))
    assert frame[5] | frame[6] << 8 == 1 + 2 * 6
    assert p.fast_blocks(frame, [2, 2]) == [(0, 1, b"\1\2")]


stream = st.lists(
    st.one_of(
        values.map(Packet.encode), values.map(lambda v: v.encode(stuffed=False)), blobs, st.binary(max_size=9)
    ),
    max_size=6,
).map(b"".join)


@given(stream, st.lists(st.integers(1, 9), max_size=80), st.booleans())
@example(bytes.fromhex("fffffd0001030001194effff"), [1] * 12, True)
def test_parsing_does_not_depend_on_chunks(data, cuts, lenient):
    whole = Parser(lenient=lenient)
    at_once = whole.feed(data) + whole.flush()
    pieces, parser, place = [], Parser(lenient=lenient), 0
    for cut in cuts:
        pieces += parser.feed(data[place : place + cut])
        place += cut
    pieces += parser.feed(data[place:]) + parser.flush()
    assert pieces == at_once


@given(stream, st.booleans())
def test_every_byte_is_a_packets_or_noise(data, lenient):
    parser = Parser(lenient=lenient)
    out = parser.feed(data) + parser.flush()
    noise = sum(len(e.data) for e in out if isinstance(e, Fault) and e.kind == "noise")
    framed = 0
    for e in out:
        if isinstance(e, Packet):
            unstuffed, stuffed = e.encode(stuffed=False), e.encode()
            framed += len(stuffed) if stuffed in data else len(unstuffed)
    assert parser.pending == 0
    assert noise + framed == len(data)


@settings(max_examples=300)
@given(stream, instructions, st.booleans())
def test_a_packet_after_anything_is_found_at_its_last_byte(junk, packet, lenient):
    """Whatever came before, even half a frame that announces more bytes, the next packet is not held back."""
    parser = Parser(lenient=lenient)
    parser.feed(junk)
    assert parser.feed(packet.encode())[-1] == packet
    assert parser.feed(p.ping(7).encode())[-1] == p.ping(7)


def test_a_truncated_frame_does_not_hold_the_next():
    long = p.write(3, 116, bytes(200)).encode()
    for lenient in (False, True):
        parser = Parser(lenient=lenient)
        assert parser.feed(long[:50]) == []
        assert parser.feed(p.ping(1).encode())[-1] == p.ping(1)
        assert parser.pending == 0 or parser.feed(p.ping(2).encode())[-1] == p.ping(2)


def test_noise_is_reported_in_bounded_pieces():
    parser = Parser()
    out = parser.feed(bytes(100_000))
    assert all(len(e.data) <= Parser.NOISE_PIECE for e in out)
    assert sum(len(e.data) for e in out) > 100_000 - Parser.NOISE_PIECE - 4
    assert parser.pending < 4
