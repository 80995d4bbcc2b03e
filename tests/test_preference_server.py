"""The server of a study: who gets what, what is refused, and that no vote is lost or doubled."""

import json
import resource
import select
import shutil
import signal
import socket
import sqlite3
import time
from contextlib import ExitStack, closing, suppress
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import pytest

from forge.damage import DAMAGES
from forge.errors import fails
from forge.people import Crowd, pair_study
from forge.servers import AT, Serving
from palpate import preference
from palpate.core import Note, PalpateError

pytest.importorskip("uvicorn", reason="uvicorn is not installed")

from preference_load import measure

from palpate.preference import server as served
from palpate.preference.plan import Plan
from palpate.preference.store import CELLS, VoteStore
from palpate.preference.votes import read_votes


@pytest.fixture(scope="module")
def study():
    return pair_study(40, 12)[0]


@pytest.fixture(scope="module")
def server(study, tmp_path_factory):
    with Serving(tmp_path_factory.mktemp("served"), study, invite=10) as running:
        yield running


def stored(server, rater):
    votes = server.json("GET", "/votes", rater)[1]["votes"]
    return {vote["trial"]: (vote["choice"], vote["undone"]) for vote in votes}


def test_an_invitation_opens_the_page_and_what_its_rater_sees(server, study):
    status, headers, page = server.request("GET", f"/?token={server.tokens['r01']}")
    assert status == 200
    assert "frame-ancestors 'none'" in headers["content-security-policy"]
    assert "default-src 'none'" in headers["content-security-policy"]
    assert headers["referrer-policy"] == "no-referrer"
    assert headers["cache-control"] == "no-store"
    assert "server" not in headers
    assert study["raters"]["r01"][0]["trial"] not in page.decode()

    status, own = server.json("GET", "/study.json", "r01")
    assert own["raters"] == {"r01": study["raters"]["r01"]}
    assert own["images"] == study["images"]


@pytest.mark.parametrize("token", [None, "", "guessed", "é", "a" * 3000])
def test_a_token_that_is_absent_or_guessed_opens_nothing(server, token):
    header = {} if token is None else {"Authorization": f"Bearer {token}".encode()}
    assert server.request("GET", "/")[0] == 403
    assert server.request("GET", "/?token=guessed%00")[0] == 403
    for method, path in (("GET", "/study.json"), ("GET", "/votes"), ("POST", "/vote")):
        assert server.request(method, path, headers=header)[0] == 403


def test_an_invitation_used_twice_is_the_same_rater(server):
    assert server.send("r03", 0, "left") == (200, {"stored": True})
    assert server.send("r03", 0, "left") == (200, {"stored": "already"})
    assert server.send("r03", 0, "right") == (200, {"stored": "already"})
    assert server.send("r03", 1, "same") == (200, {"stored": True})
    first, second = (row["trial"] for row in server.public["raters"]["r03"][:2])
    assert stored(server, "r03") == {first: ("left", 0), second: ("same", 0)}


def test_only_a_vote_after_an_undo_replaces_one(server):
    assert server.send("r04", 0, "left", undone=1) == (200, {"stored": True})
    assert server.send("r04", 0, "same", undone=0) == (200, {"stored": "already"})
    assert server.send("r04", 0, "right", undone=2) == (200, {"stored": True})
    assert list(stored(server, "r04").values()) == [("right", 2)]


HOSTILE = {
    "no JSON": b"left",
    "no text": b"\xff\xfe",
    "nested": b"[" * 4000,
    "a long number": b"1" * 4090,
    "a list": [1, 2],
    "nothing": b"",
    "a field too many": {"admin": True},
    "another study": {"study": "0" * 12},
    "an unknown trial": {"trial": "../../plan.json"},
    "another rater's trial": {"trial": "' OR 1=1 --"},
    "an unknown choice": {"choice": "<script>alert(1)</script>"},
    "half a character": {"choice": "\ud800"},
    "a list as choice": {"choice": ["left"]},
    "a bool as time": {"ms": True},
    "a negative time": {"ms": -1},
    "a huge time": {"ms": 10**30},
    "a fraction": {"ms": 1.5},
    "no number": {"ms": float("nan")},
    "no date": {"at": "yesterday"},
    "month 13": {"at": "2026-13-45T99:99:99Z"},
    "the 30th of February": {"at": "2026-02-30T10:00:00Z"},
    "year 0": {"at": "0000-01-01T00:00:00Z"},
    "hour 24": {"at": "2026-01-31T24:00:00Z"},
    "Arabic digits": {"at": "\u0662\u0660\u0662\u0666-01-31T10:00:00Z"},
    "undone a thousand times": {"undone": 1000},
}


@pytest.mark.parametrize("body", HOSTILE.values(), ids=HOSTILE)
def test_a_hostile_body_is_answered_with_400(server, body):
    if isinstance(body, dict):
        body = server.vote("r05") | body
    status, answer = server.json("POST", "/vote", "r05", body)
    assert status == 400
    assert list(answer) == ["error"]
    assert stored(server, "r05") == {}


def test_a_long_body_and_the_vote_of_another_rater_are_refused(server):
    assert server.json("POST", "/vote", "r07", server.vote("r08"))[0] == 403
    long = json.dumps(server.vote("r06")) + " " * 4096
    assert server.request("POST", "/vote", "r06", long)[0] == 413
    parts = (b" " * 1000 for _ in range(10))  # sent in chunks, without a length
    assert server.request("POST", "/vote", "r06", parts)[0] == 413


PATHS = ["/plan.json", "/study.db", "/../plan.json", "/%2e%2e/plan.json", "//etc/passwd", "/votes/"]
PATHS += ["/..%2fplan.json", "/static/../../etc/passwd", "/%00", "/study.json%00.txt", "/vote/../x"]
PATHS += ["/\\..\\plan.json", "/.git/config", "/docs", "/openapi.json"]


def test_there_is_nothing_but_the_routes(server):
    assert {server.request("GET", path, "r07")[0] for path in PATHS} == {404}
    assert {server.request(method, "/vote", "r07")[0] for method in ("GET", "PUT", "DELETE")} == {
        405
    }


def test_tokens_are_stored_hashed(server):
    files = [p.read_bytes() for p in server.folder.glob("study.db*")]
    assert not any(token.encode() in file for token in server.tokens.values() for file in files)


def test_too_many_requests_of_one_rater_are_answered_with_429(server):
    statuses = [server.request("GET", "/votes", "r09") for _ in range(130)]
    status, headers, _ = statuses[-1]
    assert (statuses[0][0], status, headers["retry-after"]) == (200, 429, "5")
    assert server.request("GET", "/votes", "r10")[0] == 200


def test_a_full_disk_loses_no_acknowledged_vote(study, tmp_path):
    """The limit on file sizes of the server's process is a full disk that can be emptied."""
    with Serving(tmp_path, study) as server:
        pid, unlimited = server.process.pid, resource.prlimit(0, resource.RLIMIT_FSIZE)
        assert server.send("r01", 0)[0] == 200
        resource.prlimit(pid, resource.RLIMIT_FSIZE, (1, unlimited[1]))
        status, headers, _ = server.request("POST", "/vote", "r01", server.vote("r01", 1))
        assert (status, headers["retry-after"]) == (507, "5")
        assert len(stored(server, "r01")) == 1
        resource.prlimit(pid, resource.RLIMIT_FSIZE, unlimited)
        assert server.send("r01", 1) == (200, {"stored": True})
        assert len(stored(server, "r01")) == 2


def test_a_full_file_system_rolls_back_the_whole_batch(tmp_path):
    store = VoteStore(tmp_path / "study.db", "abc")
    pages = store._disk.execute("PRAGMA page_count").fetchone()[0]
    store._disk.execute(f"PRAGMA max_page_count = {pages}")
    votes = [
        {"rater": "r01", "trial": f"{k:020}", "choice": "left", "ms": 1, "at": "", "undone": 0}
        | {"received": ""}
        for k in range(200)
    ]
    with pytest.raises(sqlite3.OperationalError, match="full"):
        store.store(votes)
    with pytest.raises(PalpateError, match=r"read and write\. Got database or disk is full"):
        store.invite([f"r{k:03}" for k in range(1, 900)], 899)
    assert (store.votes("r01"), store.raters()) == ([], {})
    assert store.store(votes[:3]) == [True] * 3
    assert store.store(votes[1:4]) == [False, False, True]
    store.close()


@pytest.mark.parametrize(
    ("planned", "until", "day"),
    [("20991231", "20200101", "2020-01-01"), ("99991231", None, "9999-12-31")],
)
def test_no_vote_counts_after_the_last_day_in_any_form(study, tmp_path, planned, until, day):
    with Serving(tmp_path, study | {"until": planned}, invite=1, until=until) as server:
        own = server.json("GET", "/study.json", "r01")[1]
        assert (own["until"], own["ended"]) == (day, day < "2026")
        assert server.send("r01")[0] == (410 if day < "2026" else 200)
        assert len(stored(server, "r01")) == (day > "2026")


def test_a_killed_server_goes_on_with_its_votes_and_invitations_but_for_a_lost_link(
    study, tmp_path
):
    with Serving(tmp_path, study, invite=3) as server:
        assert server.send("r01", 0) == (200, {"stored": True})
        assert server.send("r03", 0, "left") == (200, {"stored": True})
        lost, others = server.tokens["r03"], {r: server.tokens[r] for r in ("r01", "r02")}
        port = server.port
        server.kill()
        server.start(port=port, invite=1, reinvite=["r03"])
        assert server.request("GET", f"/?token={lost}")[0] == 403
        assert list(stored(server, "r03").values()) == [("left", 0)]
        assert {r: server.tokens[r] for r in others} == others
        assert sorted(server.tokens) == ["r01", "r02", "r03", "r04"]
        assert all(server.request("GET", "/votes", r)[0] == 200 for r in server.tokens)
        assert server.send("r01", 0) == (200, {"stored": "already"})
        assert server.send("r04", 0) == (200, {"stored": True})


@pytest.fixture(scope="module")
def planned(rated, tmp_path_factory):
    folder = tmp_path_factory.mktemp("planned") / "study"
    rated.make(folder, items=4, raters=2, count=2, size=32)
    return folder


def voted(planned, folder, number):
    """A folder with all votes of a served study, whose process a signal ended; its exit status."""
    shutil.copytree(planned, folder)
    plan = Plan.load(folder)
    with Serving(folder, plan.public(), verb=True) as server:
        for rater in server.tokens:
            for vote in Crowd({"ours": 1.0, "gvst": 0.0}).download(plan, rater)["votes"]:
                vote |= {"study": plan.study, "rater": rater, "at": AT}
                assert server.json("POST", "/vote", rater, vote)[0] == 200
        assert {p.stat().st_mode & 0o77 for p in folder.glob("*.db*")} == {0}
        assert (folder / "plan.json").stat().st_mode & 0o77 == 0
        server.kill(number)
    return 2 * len(plan.trials), server.process.returncode


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_server_that_is_stopped_leaves_all_votes_in_one_file(planned, tmp_path, number):
    if signal.getsignal(number) is signal.SIG_IGN:
        pytest.skip("these tests run under nohup, and so would the server")
    count, status = voted(planned, tmp_path / "study", number)
    assert status in (0, 130)
    assert [path.name for path in (tmp_path / "study").glob("study.db*")] == ["study.db"]
    results = preference.score(tmp_path / "study", replicates=100)
    assert sum(r["votes"] for r in results.settings["preference"]["raters"]) == count
    assert not any(note.code == "votes-so-far" for note in results.notes)


def test_the_file_of_a_killed_server_holds_all_votes_or_is_refused(planned, tmp_path):
    folder = tmp_path / "study"
    count, _ = voted(planned, folder, signal.SIGKILL)
    shutil.copytree(planned, tmp_path / "copy")
    copy = Path(
        shutil.copy(folder / "study.db", tmp_path / "copy")
    )  # alone, without what lies beside it
    so_far = Note("votes-so-far", {"count": count})
    assert so_far in preference.score(tmp_path / "copy", replicates=100).notes
    for file, damage in product(sorted(folder.glob("study.db*")), DAMAGES):
        whole = file.read_bytes()
        damage(file)
        with suppress(PalpateError):
            assert so_far in preference.score(folder, replicates=100).notes, (file, damage)
        file.write_bytes(whole)
    for path in (folder / "study.db", copy):
        with closing(sqlite3.connect(path)) as disk, disk:
            disk.execute("DELETE FROM votes WHERE rater = 'r02'")
        text = rf"the {count} that its server counted\. Got {count // 2}"
        fails(text, preference.score, path.parent)
        VoteStore(path, Plan.load(folder).study).close()  # it counts anew
        notes = preference.score(path.parent, replicates=100).notes
        assert not any(note.code == "votes-so-far" for note in notes)


def test_a_kill_in_the_middle_of_a_write_loses_no_vote_silently(planned, tmp_path):
    """Every number of its pages may be on disk, with the journal whole, damaged or lost."""
    folder = Path(shutil.copytree(planned, tmp_path / "study"))
    plan, file, journal = Plan.load(folder), folder / "study.db", folder / "study.db-journal"

    def rows(rater):
        votes = Crowd({"ours": 1.0, "gvst": 0.0}).download(plan, rater)["votes"]
        return [v | {"rater": rater, "received": AT} for v in votes]

    def counted():
        """Votes by rater; None where the file is refused."""
        with suppress(PalpateError):
            votes = read_votes(plan, [file]).by_rater
            return {rater: len(of_rater) for rater, of_rater in votes.items()}
        return None

    first, second = (rows(rater.code) for rater in plan.raters)
    columns = [*CELLS, "received", "rater"]
    insert = f"INSERT INTO votes ({', '.join(columns)}) VALUES (:{', :'.join(columns)})"
    with closing(VoteStore(file, plan.study)) as store:
        store.store(first)
        before = file.read_bytes()
        with closing(sqlite3.connect(file, isolation_level=None)) as disk:
            disk.execute("PRAGMA cache_size = 1")  # pages are written before the transaction ends
            disk.execute("BEGIN")
            disk.executemany(
                insert, [v | {"trial": f"{v['trial']}{k:03}"} for v in second for k in range(40)]
            )
            begun, written = file.read_bytes(), journal.read_bytes()
            disk.execute("ROLLBACK")
    earlier, size = {plan.raters[0].code: len(first)}, 4096
    pages = [k for k in range(0, len(begun), size) if begun[k : k + size] != before[k : k + size]]
    assert len(pages) > 1
    whole = lambda file: None
    for number, damage in product(
        range(len(pages) + 1), (whole, *DAMAGES, Path.unlink, lambda file: file.write_bytes(b""))
    ):
        state = bytearray(before.ljust(len(begun) if number else len(before), b"\0"))
        for k in pages[:number]:
            state[k : k + size] = begun[k : k + size]
        file.write_bytes(state)
        journal.write_bytes(written)
        damage(journal)
        results = [counted()]
        with suppress(PalpateError):  # as it advises
            VoteStore(file, plan.study).close()
        results.append(counted())
        case = number, damage, results
        assert all(result in (None, earlier) for result in results), case
        assert damage is not whole or results[1] == earlier, case
    file.write_bytes(begun)
    journal.write_bytes(written)
    fails("serve the study once more and stop it", preference.score, folder)


def test_a_flipped_bit_in_the_file_of_votes_changes_none(planned, tmp_path):
    folder = Path(shutil.copytree(planned, tmp_path / "study"))
    plan, file = Plan.load(folder), folder / "study.db"
    with closing(VoteStore(file, plan.study)) as store:
        for rater in plan.raters:
            votes = Crowd({"ours": 1.0, "gvst": 0.0}).download(plan, rater.code)["votes"]
            store.store([v | {"rater": rater.code, "received": AT} for v in votes])
    whole, votes, refused = file.read_bytes(), read_votes(plan, [file]).by_rater, 0
    for place in range(7, len(whole), 29):
        file.write_bytes(whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :])
        try:
            assert read_votes(plan, [file]).by_rater == votes, place
        except PalpateError:
            refused += 1
    assert refused > 50


def test_damaged_names_in_the_file_of_votes_are_refused(planned, tmp_path):
    folder = Path(shutil.copytree(planned, tmp_path / "study"))
    store = folder / "study.db"
    VoteStore(store, Plan.load(folder).study).close()
    whole = store.read_bytes()
    for name in (b"TABLE", b"study", b"votes", b"name"):
        store.write_bytes(whole.replace(name, name[:-1] + b"\x87"))
        fails("must be a file of votes|must be of study", preference.score, folder)


def half_open(server, address, count):
    """Connections from an address of this machine that never end the head of their request."""
    sockets = []
    for _ in range(count):
        peer = ("127.0.0.1", server.port)
        sockets.append(socket.create_connection(peer, source_address=(address, 0)))
        sockets[-1].sendall(b"GET / HTTP/1.1\r\nHost: study\r\n")
    return sockets


def open_ones(sockets):
    """How many of some connections the server has not closed."""
    closed, _, _ = select.select(sockets, [], [], 0)
    return len(sockets) - len(closed)


def test_raters_are_served_while_others_hold_connections_open(study, tmp_path):
    with Serving(tmp_path, study, wait=3.0) as server, ExitStack() as stack:
        for addresses, most in (("3", served.MOST_OF_ADDRESS), ("456789", served.MOST_WAITING)):
            sockets = [
                stack.enter_context(each)
                for address in addresses
                for each in half_open(server, f"127.0.0.{address}", 300 // len(addresses))
            ]
            start = time.monotonic()
            for k in range(10):
                assert server.send("r01", k)[0] == 200
                assert server.request("GET", "/study.json", "r02")[0] == 200
            assert time.monotonic() - start < 10  # 20 requests
            assert 0 < open_ones(sockets) <= most
        body = server.json("GET", "/votes", "r01")[1]
        assert len(body["votes"]) == 10
        time.sleep(max(0, start + 4 - time.monotonic()))
        assert open_ones(sockets) == 0


def test_a_body_that_does_not_come_is_not_waited_for(study, tmp_path):
    with Serving(tmp_path, study, wait=0.5) as server:
        head = "POST /vote HTTP/1.1\r\nHost: study\r\nAuthorization: Bearer {}\r\n"
        for token, status in ((server.tokens["r01"], b" 408 "), ("guessed", b" 403 ")):
            with socket.create_connection(("127.0.0.1", server.port), timeout=5) as slow:
                slow.sendall(head.format(token).encode() + b"Content-Length: 4000\r\n\r\n{")
                assert status in slow.recv(4096)
                closed = False
                for _ in range(30):  # a drop now and then keeps no connection
                    with suppress(OSError):
                        slow.sendall(b" ")
                    time.sleep(0.1)
                    if closed := bool(select.select([slow], [], [], 0)[0]):
                        break
                assert closed
        assert server.send("r01")[0] == 200


def test_no_vote_is_lost_or_double_when_the_server_is_killed(tmp_path):
    row = measure(tmp_path, raters=10, votes=10, kills=2)
    assert (row["acknowledged"], row["stored"], row["lost"], row["double"]) == (100, 100, 0, 0)
    assert row["again"] > 0


def test_who_cannot_be_invited_is_said(tmp_path):
    store = VoteStore(tmp_path / "study.db", "abc")
    fails(r"must be 0 or more\. Got -3", store.invite, ["r01", "r02", "r03", "r04"], -3)
    fails(r"r01 to r02\. Got 'r99'", store.invite, ["r01", "r02"], 1, ["r99"])
    assert store.raters() == {}
    store.close()


def test_what_cannot_be_served_is_an_error(study, tmp_path, monkeypatch):
    monkeypatch.setattr(served.Plan, "load", lambda folder: SimpleNamespace(public=lambda: study))
    for name in ("other", "text", "fresh"):
        (tmp_path / name).mkdir()
    VoteStore(tmp_path / "other" / "study.db", "another study").close()
    (tmp_path / "text" / "study.db").write_text("no database" * 100)
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        cases = {
            "must be of study": {"study": tmp_path / "other"},
            "must be a file of votes": {"study": tmp_path / "text"},
            "must be at most 12": {"invite": 13},
            "must be a date. Got 'soon'": {"until": "soon", "port": port},
            "must be a date. Got '2026-11-5'": {"until": "2026-11-5", "port": port},
            "free address": {"port": port},
            "needs a free": {"port": 99999},
            "a free address. Got no-host.invalid": {"host": "no-host.invalid"},
        }
        for message, options in cases.items():
            fails(message, served.serve, **{"study": tmp_path / "fresh"} | options)
