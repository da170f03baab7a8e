/* Declarations of ArduPilot, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#include <AP_HAL/AP_HAL.h>
#include <string.h>
/* One thread pushes, another one pops. */
template <class T> class ObjectBuffer {
public:
    ObjectBuffer(uint32_t _size = 0) : size(_size + 1), room(new T[_size + 1]) {}
    ~ObjectBuffer() { delete[] room; }
    uint32_t get_size() const { return size - 1; }
    bool set_size(uint32_t _size)
    {
        delete[] room;
        size = _size + 1;
        room = new T[size];
        head.store(0);
        tail.store(0);
        return true;
    }
    uint32_t available() const { return (tail.load() + size - head.load()) % size; }
    uint32_t space() const { return size - 1 - available(); }
    bool is_empty() const WARN_IF_UNUSED { return available() == 0; }
    bool push(const T &object)
    {
        if (space() == 0) {
            return false;
        }
        room[tail.load()] = object;
        tail.store((tail.load() + 1) % size);
        return true;
    }
    bool pop(T &object) WARN_IF_UNUSED
    {
        if (available() == 0) {
            return false;
        }
        object = room[head.load()];
        head.store((head.load() + 1) % size);
        return true;
    }

private:
    uint32_t size;
    T *room;
    struct Place {
        uint32_t load() const { return __atomic_load_n(&at, __ATOMIC_SEQ_CST); }
        void store(uint32_t to) { __atomic_store_n(&at, to, __ATOMIC_SEQ_CST); }
        uint32_t at = 0;
    };
    Place head;
    Place tail;
};
