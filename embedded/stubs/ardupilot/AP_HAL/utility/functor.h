/* Declarations of ArduPilot, as a firmware engineer sees them: names, types and what is private. Written for tests. MIT. */
#pragma once
#define FUNCTOR_TYPEDEF(name, rettype, ...) typedef Functor<rettype, ##__VA_ARGS__> name
#define FUNCTOR_BIND_MEMBER(func, rettype, ...) \
    Functor<rettype, ##__VA_ARGS__>::bind<StubPlain<decltype(*this)>::type, func>(this)
template <class T> struct StubPlain {
    typedef T type;
};
template <class T> struct StubPlain<T &> {
    typedef T type;
};
template <class R, class... Args> class Functor {
public:
    constexpr Functor(void *object, R (*method)(void *, Args...)) : _object(object), _method(method) {}
    R operator()(Args... args) const { return _method(_object, args...); }
    template <class T, R (T::*method)(Args...)> static constexpr Functor bind(T *object)
    {
        return Functor(object, &call<T, method>);
    }

private:
    void *_object;
    R (*_method)(void *, Args...);
    template <class T, R (T::*method)(Args...)> static R call(void *object, Args... args)
    {
        return (static_cast<T *>(object)->*method)(args...);
    }
};
