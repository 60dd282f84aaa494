"""Analyses over REST: begun, watched and taken away, on a file and on a session; refused in plain words."""

import numpy as np

from tests.end_to_end.running import wait_for

LASER_MM = [0.0, 0.0, -80.0]


def over(client, address):
    def look():
        found = client.get(address).json()
        return found if found["state"] in ("done", "failed") else None

    wait_for(lambda: look() is not None, "the analysis to end")
    return look()


def test_a_file_and_a_session_are_analysed_and_wrong_requests_are_refused(service):
    client = service.client
    rng = np.random.default_rng(1)
    ball = rng.normal(size=(500, 3))
    ball *= 10.0 / np.linalg.norm(ball, axis=1, keepdims=True)
    np.savetxt(service.data / "replay" / "ball.xyz", ball)
    body = {
        "method": "bivariate_quadric",
        "source": {"kind": "file", "file": "ball.xyz", "seen_from_mm": [0, 0, 0]},
    }
    begun = client.post("/api/v1/analyses", json=body)
    assert begun.status_code == 202, begun.text
    address = begun.headers["Location"]
    job = over(client, address)
    assert (job["state"], job["points"], job["progress"]) == ("done", 500, 1.0)
    assert abs(job["summary"]["curvature_1_per_mm"]["median"] - 0.1) < 0.02  # bends towards the middle, as seen from it
    page = client.get(f"{address}/points", params={"start": 400, "limit": 200}).json()
    assert (page["total"], page["next"], len(page["normals"])) == (500, None, 100)
    ply = client.get(f"{address}/points.ply").content
    assert ply.startswith(b"ply\n")
    assert b"property double scalar_curvature_1_per_mm" in ply

    body = {"method": "fixed_radius", "source": {"kind": "file", "file": "ball.xyz"}, "orient": True}
    body["options"] = {"radius_mm": 5.0, "max_error_deg": 30}
    address = client.post("/api/v1/analyses", json=body).headers["Location"]
    job = over(client, address)
    assert job["state"] == "done", job
    (component,) = job["summary"]["orientation"]["largest_components"]
    assert (component["points"], component["confidence"], component["warning"]) == (500, 1.0, None)
    page = client.get(f"{address}/points").json()
    assert (np.sum(np.array(page["normals"]) * page["points_mm"], axis=1) > 0).all()
    assert (set(page["component"]), set(page["sure"])) == ({0.0}, {1.0})

    session = service.create(kind="push")
    service.start(session)
    lines = [
        {
            "line_index": i,
            "line_spacing_mm": 0.2,
            "laser_mm": LASER_MM,
            "points_mm": [[0.2 * j, 0.2 * i, 0.0] for j in range(20)],
        }
        for i in range(20)
    ]
    assert client.post(f"/api/v1/sessions/{session}/scanlines", json={"lines": lines}).status_code == 200
    begun = client.post(
        "/api/v1/analyses", json={"method": "gaussian", "source": {"kind": "session", "session_id": session}}
    )
    job = over(client, begun.headers["Location"])
    assert job["state"] == "done", job
    normals = client.get(f"{begun.headers['Location']}/points").json()["normals"]
    np.testing.assert_allclose(np.array(normals), np.tile([0, 0, -1], (400, 1)), atol=1e-6)  # the laser stood below

    listed = client.get("/api/v1/analyses").json()
    assert [item["id"] for item in listed["analyses"]] == ["a3", "a2", "a1"]
    for wrong, status, slug in (
        ({"source": body["source"] | {"seen_from_mm": [0, 0, 9]}, "orient": True}, 422, "invalid-value"),
        ({"method": "magic"}, 422, "method-unknown"),
        ({"method": "gaussian", "options": {"ball_factor": 2}}, 422, "method-refused"),
        ({"options": {"radius_mm": 1, "neighbours": 9}}, 422, "invalid-value"),
        ({"options": {"radius_mm": -1}}, 422, "invalid-request"),
        ({"source": {"kind": "file", "file": "absent.xyz"}}, 422, "source-unusable"),
        ({"source": {"kind": "file", "file": "../record.sqlite"}}, 422, "invalid-request"),
        ({"source": {"kind": "session", "session_id": "0nobody"}}, 404, "session-unknown"),
    ):
        refused = client.post("/api/v1/analyses", json=body | {"method": "orthogonal_distance"} | wrong)
        assert refused.status_code == status, refused.text
        assert refused.json()["type"] == f"/problems/{slug}"
    assert client.delete(address).status_code == 204
    assert client.get(address).status_code == 404


def test_clouds_that_make_no_sense_end_with_reasons_or_a_sentence(service):
    client = service.client
    rng = np.random.default_rng(2)
    clouds = {
        "few": rng.normal(size=(4, 3)),
        "line": np.outer(np.arange(40.0), [1.0, 2.0, 3.0]),
        "plane": np.column_stack([rng.uniform(size=(60, 2)), np.zeros(60)]),
        "doubled": np.repeat(rng.normal(size=(30, 3)), 3, axis=0),
        "outlier": np.vstack([rng.normal(size=(60, 3)), [[1e8, 0.0, 0.0]]]),
        "nan": np.full((20, 3), np.nan),
    }
    for name, points in clouds.items():
        np.savetxt(service.data / "replay" / f"{name}.xyz", points)
        for method in ("big_delaunay_balls",) if name != "line" else ("general_quadric",):
            body = {"method": method, "source": {"kind": "file", "file": f"{name}.xyz"}, "orient": name == "doubled"}
            begun = client.post("/api/v1/analyses", json=body)
            assert begun.status_code == 202, begun.text
            job = over(client, begun.headers["Location"])
            if job["state"] == "failed":
                assert 40 < len(job["message"]) < 400, (name, method, job)
            else:
                assert sum(job["summary"]["reasons"].values()) == job["points"], (name, method, job)
    assert client.get("/healthz").status_code == 200
