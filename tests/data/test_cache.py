from qgs.data.scenes import BoundedCache


def test_what_was_used_last_is_kept():
    made = []
    cache = BoundedCache(6, len)

    def get(key):
        def make():
            made.append(key)
            return key

        return cache.get(key, make)

    for key in ("aaa", "bbb", "aaa", "ccc", "aaa", "bbb"):
        assert get(key) == key
    assert made == ["aaa", "bbb", "ccc", "bbb"]
    assert get("longer than all") == "longer than all"
    assert made[-1] == "longer than all"
    get("aaa")
    assert made[-1] == "aaa"
